"""Budgets of assets over eight scenes: forty errors and twenty times, as they came out.

``python tests/measured/budgets.py [--quick] [--to FOLDER] [name ...]`` runs each job in this
process and writes ``measured/budgets.md`` below the folder.  Errors are measured anew, by cameras
and turns of the light that neither the search nor the job's validation looked at.  It fails where
an asset errs by more than what was asked for, too few come near it, or a time is overrun.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from measured.effect_scenes import SCENES, EffectScene
from measured.effects import machine_line
from measured.options import Options
from measured.pages import table
from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs import validate
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.report.account import pooled_budget
from support.local_stages import registered, run_stages

HEADER = "<!-- Written by `make budgets` (tests/measured): change that, not this page. -->"
NAMES = (
    "icosphere-plane", "teapot", "bunny-grey", "bunny-plane", "suzanne-box", "spot", "fandisk",
    "shaderball",
)  # fmt: skip
TARGETS = (0.25, 0.18, 0.13, 0.1, 0.08)
TIMES = dict.fromkeys(NAMES, (30.0, 120.0)) | dict.fromkeys(NAMES[:4], (30.0, 60.0, 120.0))
QUICK_TARGETS = (0.18,)
QUICK_TIMES = (30.0,)
SKY = {"name": "sun_sky", "width": 128}
NEAR = 0.6
LEAST_NEAR = 0.75
"""Share of the errors asked for that are to come to `NEAR` of them at least."""

OVERRUN = 1.1

NO_RESOURCE = "0" * 16
LATER = {
    "render": {"width": 160, "height": 120},
    "validation": {"width": 96, "height": 72, "passes": 8},
}
HELD_OUT = ValidateSettings(
    cameras=[
        Camera(name=f"held-out-{index}", azimuth_deg=10.0 + 90.0 * index, elevation_deg=elevation)
        for index, elevation in enumerate((15.0, 30.0, 22.0, 40.0))
    ],
    width=96,
    height=72,
    passes=8,
    samples=1024,
    rotations_deg=[(0.0, 0.0, 0.0), (0.0, 100.0, 0.0), (0.0, 235.0, 0.0)],
)
ABOUT = f"""\
Each scene, under the built-in sky with its sun, is asked for as an `asset` job with a budget in place of a quality; all
tasks run in one process, one after the other. *Error* is the total of the error budget at {len(HELD_OUT.cameras)} cameras
under {len(HELD_OUT.rotations_deg)} turns of the light each, which neither the search nor the job's own validation looked at,
pooled over all of them; *share* is that over what was asked for. Where a target cannot be met the job says so, and what
can be asked for. *Seconds* are the job's, by the clock."""


@dataclass(frozen=True)
class Met:
    """One job with an error: what was asked for, and what its asset errs by; None if refused."""

    title: str
    asked: float
    error: float | None
    n_bytes: int
    seconds: float
    said: str = ""

    @property
    def share(self) -> float | None:
        """Of what was asked for."""
        return None if self.error is None else self.error / self.asked


@dataclass(frozen=True)
class Kept:
    """One job with a time: what was asked for, and what it took; the quality that it made."""

    title: str
    asked: float
    seconds: float
    said: str


class BudgetJobs:
    """Jobs of one scene, its mesh and sky registered once."""

    def __init__(self, scene: EffectScene, store: BlobStore, data: Path) -> None:
        self.scene, self.store = scene, store
        self.request = {
            "kind": "asset",
            "mesh": f"mesh-{NO_RESOURCE}",
            "environment": f"environment-{NO_RESOURCE}",
            "settings": LATER,
            **scene.request,
        }
        self.context: dict[str, Any] = {
            "mesh": registered(store, "mesh", **scene.mesh(store, data)),
            "environment": registered(store, "environment", builtin=SKY),
            "brdf": {"spec": scene.request["brdf"]},
            "albedo_texture": None,
            "materials": {
                name: {"spec": material["brdf"]}
                for name, material in scene.request.get("materials", {}).items()
            },
            "artefacts": {},
        }
        if scene.texture is not None:
            digest = store.put_bytes(scene.texture(data))
            self.request["albedo_texture"] = self.context["albedo_texture"] = digest

    def run(self, budget: dict[str, float]) -> tuple[dict[str, Any] | str, float]:
        """Run a job; its result with its files by name, or why it was refused, and its seconds."""
        asked = self.request | {"budget": budget}
        request = job_request_adapter.validate_python(asked).model_dump(mode="json")
        began = time.time()
        context = self.context | {"started": began}
        try:
            results: Results = run_stages(REGISTRY.stages("asset", request, context), self.store)
        except SettingsError as error:
            return error.detail, time.time() - began
        seconds = time.time() - began
        finished = REGISTRY.finish("asset", request, context, results)
        files = {file[0]: file[2] for file in finished.artefacts}
        return finished.result | {"files": files}, seconds

    def met(self, target: float, held_out: ValidateSettings) -> Met:
        """Ask for an error, and measure what came at held-out views and lights."""
        found, seconds = self.run({"max_error": target})
        if isinstance(found, str):
            return Met(self.scene.title, target, None, 0, seconds, found)
        inputs = {
            "transfer": found["files"]["transfer.h5"],
            "asset": found["files"]["asset.h5"],
            "exact": found["files"]["asset-float32.h5"],
            "light": found["files"]["light.h5"],
        }
        environment = self.context["environment"]["canonical"]
        stages = validate.stages(lambda _: inputs, environment, held_out, 91)
        cameras = run_stages(stages, self.store)["validate"]
        total = pooled_budget([view for camera in cameras for view in camera["views"]])["total"]
        return Met(self.scene.title, target, total, found["bytes"]["asset.h5"], seconds)

    def kept(self, seconds: float) -> Kept:
        """Ask for a time, and see what was taken."""
        found, took = self.run({"max_seconds": seconds})
        said = "refused"
        if not isinstance(found, str):
            said = next(one["name"] for one in found["search"]["attempts"] if one["taken"])
        return Kept(self.scene.title, seconds, took, said)


def statements(met: Sequence[Met], kept: Sequence[Kept]) -> list[tuple[bool, str]]:
    """Say whether each promise holds, and by what figures."""
    shares = [one.share for one in met if one.share is not None]
    above = sum(share > 1.0 for share in shares)
    near = sum(NEAR <= share <= 1.0 for share in shares)
    late = sum(one.seconds > OVERRUN * one.asked for one in kept if one.said != "refused")
    return [
        (above == 0, f"no asset errs by more than what was asked for: {above} of {len(met)} do"),
        (
            near >= LEAST_NEAR * len(met),
            f"three in four err by at least {NEAR:g} of it: {near} of {len(met)} do, "
            f"{len(met) - len(shares)} were refused",
        ),
        (late == 0, f"no time is overrun by more than a tenth: {late} of {len(kept)} are"),
    ]


def page(met: Sequence[Met], kept: Sequence[Kept], machine: str) -> str:
    """Return the whole page."""
    errors = [
        (
            one.title, f"{100 * one.asked:g} %",
            "refused" if one.error is None else f"{100 * one.error:.3g} %",
            "–" if one.share is None else f"{one.share:.2f}",
            f"{one.n_bytes / 1000:,.0f} kB", f"{one.seconds:.0f}",
        )
        for one in met
    ]  # fmt: skip
    times = [(one.title, f"{one.asked:g}", f"{one.seconds:.1f}", one.said) for one in kept]
    said = "".join(
        f"- {text}: {'holds' if holds else 'does not hold'}.\n"
        for holds, text in statements(met, kept)
    )
    head = ("scene", "asked", "error", "share", "bytes", "seconds")
    return (
        f"{HEADER}\n\n# Budgets that were asked for\n\n{ABOUT}\n\n{machine}\n\n"
        f"## What holds\n\n{said}\n## Errors\n\n{table(head, errors)}\n"
        f"\n## Times\n\n{table(('scene', 'seconds asked', 'taken', 'made'), times)}\n"
    )


def main(arguments: list[str]) -> int:
    """Measure the scenes named, or all; 1 where a promise does not hold."""
    options = Options.read(arguments, "Hold budgets against finished assets.", NAMES)
    met: list[Met] = []
    kept: list[Kept] = []
    for scene in (one for one in SCENES if one.name in options.names):
        with TemporaryDirectory(prefix="prtbake-budgets-") as folder:
            jobs = BudgetJobs(scene, open_store((Path(folder) / "blobs").as_uri()), options.data)
            for target in QUICK_TARGETS if options.quick else TARGETS:
                met.append(one := jobs.met(target, HELD_OUT))
                share = "refused" if one.share is None else f"{one.share:.3f}"
                tell(f"{one.title}: asked {target:g}, {share}, {one.seconds:.0f} s {one.said}")
            for seconds in QUICK_TIMES if options.quick else TIMES[scene.name]:
                kept.append(own := jobs.kept(seconds))
                tell(f"{own.title}: {seconds:g} s asked, {own.seconds:.1f} taken, {own.said}")
    to = options.to / "measured" / "budgets.md"
    to.parent.mkdir(parents=True, exist_ok=True)
    to.write_text(page(met, kept, machine_line()))
    for holds, text in statements(met, kept):
        tell(f"{'holds' if holds else 'FAILS'}: {text}")
    return 0 if all(holds for holds, _ in statements(met, kept)) else 1


def tell(line: str) -> None:
    """Say how far it is."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
