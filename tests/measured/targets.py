"""Forty errors asked of compression, over eight scenes: what the delivered files err by.

``python tests/measured/targets.py [--quick] [--to FOLDER] [name ...]`` bakes the scenes as planning
decides, compresses each to five errors and writes ``measured/targets.md`` below the folder.  It
fails where a file errs by more than what was asked for, or fewer than nine in ten come near it.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from measured.effect_runs import Bakes
from measured.effect_scenes import ABOUT_SETTINGS, SCENES, SETTINGS, EffectScene
from measured.effects import machine_line
from measured.options import Options
from measured.pages import table
from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.settings import BakeSettings, CompressSettings
from prtbake_workers.jobs.compress import standalone_stages
from support.local_stages import run_stages

HEADER = "<!-- Written by `make targets` (tests/measured): change that, not this page. -->"
NAMES = (
    "teapot", "bunny-grey", "bunny-plane", "suzanne-box", "spot", "dragon", "fandisk", "shaderball"
)  # fmt: skip
TARGETS = (0.05, 0.02, 0.01, 0.004, 0.002)
QUICK_TARGETS = (0.05,)
NEAR = 0.9
"""Share of the target that the error of a file comes to at least, to be near it."""

MOST_OFF = 0.1
"""Share of the files that need not be near."""

ABOUT = f"""\
Each scene is baked once and compressed with `max_error` set to five squared-error ratios, of every part
against the transfer that was given. *Error* is that of the delivered file, rounding included, measured from it:
the part that errs most. *Share* is that over what was asked for. *Bytes* are those of `asset.h5`, mesh and view
textures included; *seconds* are of all tasks of the compress job in one process, by the clock. The method is
planning's: clustered PCA for parts of one term, tensors for others. Settings of the bakes: {ABOUT_SETTINGS}."""


@dataclass(frozen=True)
class Target:
    """One compress job: what was asked for, what its file errs by, and what it took."""

    title: str
    asked: float
    error: float
    n_bytes: int
    seconds: float

    @property
    def share(self) -> float:
        """Of what was asked for."""
        return self.error / self.asked


def measure(
    scene: EffectScene, data: Path, targets: Sequence[float], settings: BakeSettings = SETTINGS
) -> list[Target]:
    """Bake a scene and compress it to each of the errors."""
    with TemporaryDirectory() as folder:
        store = open_store((Path(folder) / "blobs").as_uri())
        run = Bakes(scene, store, data, settings).run({})
        transfer = store.put_file(run.transfer, move=False)
        return [_compressed(scene.title, store, transfer, asked) for asked in targets]


def _compressed(title: str, store: BlobStore, transfer: str, asked: float) -> Target:
    results = run_stages(standalone_stages(transfer, CompressSettings(max_error=asked), 0), store)
    made = results["quantise"][0]
    seconds = sum(cost.seconds for name in results for cost in results.measured(name))
    return Target(title, asked, max(made["delivered"]["parts"].values()), made["bytes"], seconds)


def statements(found: Sequence[Target]) -> list[tuple[bool, str]]:
    """Say whether each promise holds, and by what figures."""
    above = sum(one.error > one.asked for one in found)
    near = sum(NEAR <= one.share <= 1.0 for one in found)
    return [
        (above == 0, f"no file errs by more than what was asked for: {above} of {len(found)} do"),
        (
            near >= (1.0 - MOST_OFF) * len(found),
            f"at least nine in ten come within a tenth below it: {near} of {len(found)} do",
        ),
    ]


def page(found: Sequence[Target], machine: str) -> str:
    """Return the whole page."""
    rows = [
        (
            one.title, f"{100 * one.asked:g} %", f"{100 * one.error:.4g} %", f"{one.share:.3f}",
            f"{one.n_bytes / 1000:,.0f} kB", f"{one.seconds:.1f}",
        )
        for one in found
    ]  # fmt: skip
    said = "".join(
        f"- {text}: {'holds' if holds else 'does not hold'}.\n" for holds, text in statements(found)
    )
    head = ("scene", "asked", "error", "share", "bytes", "seconds")
    return (
        f"{HEADER}\n\n# Errors that are asked for\n\n{ABOUT}\n\n{machine}\n\n"
        f"## What holds\n\n{said}\n## Scene by scene\n\n{table(head, rows)}\n"
    )


def main(arguments: list[str]) -> int:
    """Measure the scenes named, or all; 1 where a promise does not hold."""
    options = Options.read(arguments, "Hold max_error against delivered files.", NAMES)
    targets = QUICK_TARGETS if options.quick else TARGETS
    found: list[Target] = []
    for scene in (one for one in SCENES if one.name in options.names):
        for one in measure(scene, options.data, targets):
            found.append(one)
            sys.stdout.write(
                f"{one.title}: asked {one.asked:g}, errs {one.error:.5g} ({one.share:.3f}), "
                f"{one.n_bytes} bytes, {one.seconds:.1f} s\n"
            )
            sys.stdout.flush()
    to = options.to / "measured" / "targets.md"
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_text(page(found, machine_line()))
    for holds, text in statements(found):
        sys.stdout.write(f"{'holds' if holds else 'FAILS'}: {text}\n")
    return 0 if all(holds for holds, _ in statements(found)) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
