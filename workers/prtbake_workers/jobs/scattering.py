"""Stage ``scattering`` of a bake: the rows that take light through a part, built once.

Every block of coefficients multiplies with the same rows, in every bounce.  Rows depend on their
vertices alone, so runs of them are built side by side.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.hdf5.bundle import read_bundle, write_bundle
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs.scene_file import PlannedScene, read_scene
from prtbake_workers.planning.scattering_cost import row_runs
from prtbake_workers.transport.part_scattering import PartScattering, ScatteringRows, build_rows
from prtbake_workers.transport.subsurface import SubsurfaceOperator

_MODULE = "prtbake_workers.jobs.scattering"
_ARRAYS = ("indptr", "columns", "values")
_COUNTS = ("start", "n_clusters", "n_triangles")


def stage() -> Stage:
    """Build the rows of all parts that scatter; no task where none does."""

    def build(results: Results) -> list[Task]:
        (planned,) = results["plan"]
        parts = planned["plan"]["parts"]
        return [
            Task(
                f"{_MODULE}:run_rows",
                {"scene": planned["scene"], "part": part, "start": start, "stop": stop},
                label=f"{parts[part]['name']} {start}-{stop}",
            )
            for part, start, stop in _runs(planned["plan"])
        ]

    return Stage("scattering", "runs of rows", 10.0, build)


def _runs(plan: dict[str, Any]) -> Iterator[tuple[int, int, int]]:
    """List part, first and last vertex, counted within the part, of all tasks in order."""
    for part in plan["bounces"]["scattering"] if plan["bounces"] else ():
        first, last = plan["parts"][part]["vertex_range"]
        for start, stop in row_runs(last - first):
            yield part, start, stop


def grouped_rows(results: Results) -> list[list[str]]:
    """List the digests of the stage's files, part by part; none of parts that do not scatter."""
    plan = results["plan"][0]["plan"]
    found: list[list[str]] = [[] for _ in plan["parts"]]
    for (part, _, _), done in zip(_runs(plan), results["scattering"], strict=True):
        found[part].append(done["rows"])
    return found


def run_rows(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: build a run of a part's rows."""
    planned = read_scene(context.store.local_path(args["scene"]))
    part = args["part"]
    dipole = planned.scattering(part)
    assert dipole is not None
    operator = SubsurfaceOperator(
        planned.scene.part(part), dipole, max_solid_angle=planned.max_solid_angle(part)
    )
    rows = build_rows(
        operator,
        args["start"],
        args["stop"],
        progress=lambda done, total: context.progress(done, total, "vertices"),
    )
    path = write_rows(context.scratch / "rows.h5", rows)
    return {"rows": context.store.put_file(path, move=True)}


def write_rows(path: Path, rows: ScatteringRows) -> Path:
    """Write rows, whose floats do not shrink."""
    arrays = {name: getattr(rows, name) for name in _ARRAYS}
    return write_bundle(path, arrays, {n: getattr(rows, n) for n in _COUNTS}, gzip_level=0)


def read_rows(path: Path) -> ScatteringRows:
    """Read what `write_rows` wrote; it raises `CorruptArtefact` as `read_bundle` does."""
    arrays, counts = read_bundle(path)
    indptr, columns, values = (arrays[name] for name in _ARRAYS)
    start, n_clusters, n_triangles = (int(counts[name]) for name in _COUNTS)
    return ScatteringRows(start, indptr, columns, values, n_clusters, n_triangles)


def part_scattering(
    planned: PlannedScene, rows: Sequence[Sequence[str]], store: BlobStore, scratch: Path
) -> list[PartScattering | None]:
    """Make S of every part from its files, as `grouped_rows` lists them; None where it is none."""
    return [
        None
        if (dipole := planned.scattering(part)) is None
        else PartScattering(
            planned.scene.part(part),
            dipole,
            rows=(read_rows(store.local_path(digest)) for digest in digests),
            max_solid_angle=planned.max_solid_angle(part),
            scratch=scratch,
        )
        for part, digests in enumerate(rows)
    ]
