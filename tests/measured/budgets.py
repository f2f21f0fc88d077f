"""Budgets of assets over eight scenes: forty errors and twenty times, as they came out.

``python tests/measured/budgets.py [--errors | --times] [--quick] [--anew] [--to FOLDER] [name ...]``
runs each job in this process.  Its row is appended to ``budgets.csv`` as it ends, and jobs that are
there already are passed over: what was interrupted goes on, and scenes can be run one at a time;
``--anew`` begins the table again.  ``budgets.md`` is written over all rows of the table.  Errors
are measured anew, by cameras and turns of the light that neither the search nor the job's
validation looked at.  It fails where an asset errs by more than what was asked for, too few come
near it, or a time is overrun.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from math import sqrt
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

# `pytest` is told this folder in pyproject.toml, a script is not
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from measured.budgets_table import (
    ERROR,
    REFUSED,
    TIME,
    Row,
    page,
    statements,
)
from measured.effect_scenes import SCENES, EffectScene
from measured.effects import machine_line
from measured.options import DOWNLOADS, ROOT, real_data, refuse_unknown
from measured.rows import append_rows, read_rows
from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.search_stages import seconds_of
from support.local_stages import registered, run_stage, run_stages

NAMES = (
    "icosphere-plane", "teapot", "bunny-grey", "bunny-plane", "suzanne-box", "spot", "fandisk",
    "shaderball",
)  # fmt: skip
TARGETS = {
    "icosphere-plane": (0.15, 0.1, 0.07, 0.057, 0.05),
    "teapot": (0.18, 0.14, 0.12, 0.105, 0.095),
    "bunny-grey": (0.15, 0.12, 0.1, 0.085, 0.07),
    "bunny-plane": (0.18, 0.14, 0.115, 0.095, 0.08),
    "suzanne-box": (0.25, 0.2, 0.17, 0.15, 0.135),
    "spot": (0.2, 0.14, 0.1, 0.085, 0.073),
    "fandisk": (0.3, 0.25, 0.21, 0.185, 0.165),
    "shaderball": (0.25, 0.2, 0.165, 0.14, 0.12),
}
"""Relative.  Those of icosphere-plane and bunny-grey go down to what takes the finest step of the
ladder, the others to 1.35 times what a refusal of 0.1 % told could be asked for."""

TIMES = dict.fromkeys(NAMES, (30.0, 120.0)) | dict.fromkeys(NAMES[:4], (30.0, 60.0, 120.0))
QUICK_TARGETS = (0.18,)
QUICK_TIMES = (30.0,)
SKY = {"name": "sun_sky", "width": 128}
NO_RESOURCE = "0" * 16
LATER = {
    "render": {"width": 160, "height": 120},
    "validation": {"width": 96, "height": 72, "passes": 8},
}
HELD_OUT = [
    Camera(name=f"held-out-{index}", azimuth_deg=40.0 + 90.0 * index, elevation_deg=elevation)
    for index, elevation in enumerate((35.0, 18.0, 45.0, 25.0))
]
TURNS = [(0.0, 44.0, 0.0), (0.0, 178.0, 0.0), (0.0, 313.0, 0.0)]
BAKES = tuple(
    f"prtbake_workers.jobs.{name}"
    for name in (
        "plan:plan", "bake:run_tile", "bake:join", "bounce:run_block", "bounce:add_bounces",
        "scattering:run_rows", "fit_light:fit",
    )
)  # fmt: skip
"""Tasks that jobs for several errors of one scene have in common: a service recalls them too."""

NOISE = 0.1
"""Of the least error that a scene is asked for, that held-out references may have."""

ABOUT = f"""\
Each scene, under the built-in sky with its sun, is asked for as an `asset` job with a budget in place of a quality; all
tasks run in one process, one after the other. *Error* is that of the delivered file against the reference at {len(HELD_OUT)}
cameras under {len(TURNS)} turns of the light each, which neither the search nor the job's own validation looked at, pooled
over all of them; *share* is that over what was asked for. What a scene is asked for starts above the least that can be, as
a refusal of 0.1 % told: just above it for icosphere-plane and bunny-grey, which takes the finest step of the ladder, and
1.35 times that of the others. The least share that a search aims at
was set by four jobs (icosphere-plane at 15 %, spot at 20, 14 and 10 %) at other held-out views. Where a target cannot be met the job says so, and what can be asked for. *Seconds* of an error are those of the
job's tasks, one after the other; bakes that jobs of one scene have in common ran once, and count for each. Those of a
time are by the clock."""


class BudgetJobs:
    """Jobs of one scene, its mesh and sky registered once."""

    def __init__(self, scene: EffectScene, store: BlobStore, data: Path) -> None:
        self.scene, self.store = scene, store
        self.references: list[str | None] = [None] * len(HELD_OUT)
        fields, context = scene.registered(store, data)
        self.request = {
            "kind": "asset",
            "mesh": f"mesh-{NO_RESOURCE}",
            "environment": f"environment-{NO_RESOURCE}",
            "settings": LATER,
            **fields,
        }
        sky = registered(store, "environment", builtin=SKY)
        self.context: dict[str, Any] = {**context, "environment": sky}

    def run(self, budget: dict[str, float]) -> tuple[dict[str, Any] | str, float]:
        """Run a job; its result with its files by name, or why it was refused, and its seconds."""
        asked = self.request | {"budget": budget}
        request = job_request_adapter.validate_python(asked).model_dump(mode="json")
        began = time.time()
        context = self.context | {"started": began}
        stages = REGISTRY.stages("asset", request, context)
        results = Results()
        try:
            for stage in stages:
                # a time has to be that of a whole job
                shared = () if "max_seconds" in budget else BAKES
                run_stage(stage, results, self.store, shared=shared)
        except SettingsError as error:
            return error.detail, self._seconds(results, began, budget)
        seconds = self._seconds(results, began, budget)
        finished = REGISTRY.finish("asset", request, context, results)
        files = {file[0]: file[2] for file in finished.artefacts}
        return finished.result | {"files": files}, seconds

    def _seconds(self, results: Results, began: float, budget: dict[str, float]) -> float:
        """Give the clock's seconds; for an error those of all tasks, bakes of other jobs too."""
        return time.time() - began if "max_seconds" in budget else seconds_of(results, results)

    def met(self, target: float) -> Row:
        """Ask for an error, and measure what came at held-out views and lights."""
        found, seconds = self.run({"max_error": target})
        if isinstance(found, str):
            return Row(self.scene.name, ERROR, target, None, 0, seconds, found)
        for one in found["search"]["attempts"]:
            tell(f"  {one['name']}: {one['error']}, {one['seconds']:.1f} s, {one['why']}")
        n_bytes, said = found["bytes"]["asset.h5"], what_was_taken(found)
        error = self.held_out(found["files"])
        return Row(self.scene.name, ERROR, target, error, n_bytes, seconds, said)

    def held_out(self, files: dict[str, str]) -> float:
        """Measure an asset; the first renders the references, which no setting of a job changes."""
        tasks = [
            Task(
                "prtbake_workers.jobs.tuning:measure",
                {
                    "transfer": files["transfer.h5"],
                    "light": files["light.h5"],
                    "asset": files["asset.h5"],
                    "environment": self.context["environment"]["canonical"],
                    "camera": camera.model_dump(mode="json"),
                    "rotations": TURNS,
                    "bounces": ValidateSettings().bounces,
                    "noise": NOISE * min(TARGETS[self.scene.name]),
                    "seed": 910_000 + 100 * index,
                    "reference": reference,
                },
                label=camera.name,
            )
            for index, (camera, reference) in enumerate(zip(HELD_OUT, self.references, strict=True))
        ]
        measured = run_stages([Stage("held out", "views", 1.0, lambda _: tasks)], self.store)
        cameras = measured["held out"]
        self.references = [camera["reference"] for camera in cameras]
        views = [view for camera in cameras for view in camera["views"]]
        squared = sum(view["squared"]["asset"] - view["variance"] for view in views)
        return sqrt(max(squared, 0.0) / sum(view["squared_norm"] for view in views))

    def kept(self, asked: float) -> Row:
        """Ask for a time, and see what was taken."""
        found, seconds = self.run({"max_seconds": asked})
        if isinstance(found, str):
            return Row(self.scene.name, TIME, asked, None, 0, seconds, REFUSED)
        n_bytes = found["bytes"]["asset.h5"]
        return Row(self.scene.name, TIME, asked, None, n_bytes, seconds, what_was_taken(found))


def what_was_taken(found: dict[str, Any]) -> str:
    """Name the attempts that are in what was delivered."""
    return "; ".join(one["name"] for one in found["search"]["attempts"] if one["taken"])


def asked_of(scene: str, *, quick: bool) -> list[tuple[str, str, float]]:
    """List a scene's jobs by their keys."""
    errors = QUICK_TARGETS if quick else TARGETS[scene]
    times = QUICK_TIMES if quick else TIMES[scene]
    return [(scene, ERROR, one) for one in errors] + [(scene, TIME, one) for one in times]


def main(arguments: list[str]) -> int:
    """Measure what is not in the table yet; 1 where a promise does not hold."""
    parser = argparse.ArgumentParser(description="Hold budgets against finished assets.")
    part = parser.add_mutually_exclusive_group()
    part.add_argument("--errors", action="store_true", help="no times")
    part.add_argument("--times", action="store_true", help="no errors")
    parser.add_argument("--quick", action="store_true", help="one job of a kind, to try it")
    parser.add_argument("--anew", action="store_true", help="forget the table that is there")
    parser.add_argument("--to", type=Path, help="folder of budgets.csv and .md")
    parser.add_argument("names", nargs="*", metavar="name", help=f"of {', '.join(NAMES)}")
    given = parser.parse_args(arguments)
    refuse_unknown(parser, given.names, NAMES)
    data = real_data(parser)
    to = given.to or (DOWNLOADS if given.quick else ROOT) / "docs" / "measured"
    to.mkdir(parents=True, exist_ok=True)
    path, machine = to / "budgets.csv", machine_line()
    if given.anew:
        path.unlink(missing_ok=True)
    done = {row.key for row in read_rows(path, Row)}
    left_out = {ERROR} if given.times else {TIME} if given.errors else set()
    for scene in (one for one in SCENES if one.name in (given.names or NAMES)):
        listed = asked_of(scene.name, quick=given.quick)
        left = [key for key in listed if key not in done and key[1] not in left_out]
        if left:
            measure(scene, left, path, data)
    rows = read_rows(path, Row)
    if not rows:
        return 0
    (to / "budgets.md").write_text(page(rows, about=ABOUT, machine=f"{machine} {so_far(rows)}"))
    for holds, text in statements(rows):
        tell(f"{'holds' if holds else 'FAILS'}: {text}")
    return 0 if all(holds for holds, _ in statements(rows)) else 1


def so_far(rows: Sequence[Row]) -> str:
    """Say how many of all jobs are in the table."""
    known = [key for name in NAMES for key in asked_of(name, quick=False)]
    done = {row.key for row in rows}
    return f"{sum(key in done for key in known)} of {len(known)} jobs are measured."


def measure(
    scene: EffectScene, keys: Sequence[tuple[str, str, float]], path: Path, data: Path
) -> None:
    """Run jobs of a scene, and enter each into the table as it ends."""
    with TemporaryDirectory(prefix="prtbake-budgets-") as folder:
        jobs = BudgetJobs(scene, open_store((Path(folder) / "blobs").as_uri()), data)
        for _, what, asked in keys:
            row = jobs.met(asked) if what == ERROR else jobs.kept(asked)
            append_rows(path, [row], Row)
            share = "" if row.share is None else f"{row.share:.3f}, "
            tell(f"{row.scene}: {what} {asked:g}, {share}{row.seconds:.1f} s, {row.said}")


def tell(line: str) -> None:
    """Say how far it is."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
