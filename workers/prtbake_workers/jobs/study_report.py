"""The last stage of a study: its points as JSON, CSV, a picture and pages."""

import csv
import json
from collections.abc import Mapping, Sequence
from io import StringIO
from typing import Any

from prtbake_storage.contract.study import laid_over
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import ArtefactFile, Task
from prtbake_workers.planning.frontier import pareto_frontier
from prtbake_workers.report.frontier_picture import frontier_png
from prtbake_workers.report.study_page import study_page

_MODULE = "prtbake_workers.jobs.study_report"
COSTS = ("seconds", "bytes")
ERROR_IS = {
    "bake": "what the projection leaves of the transport in directions that it was not fitted in: "
    "squared, weighted by area, over the transport sampled there",
    "compress": "what the delivered asset, decoded, leaves of the transfer that it was compressed "
    "from: squared, weighted by area, all parts together, over the transfer",
    "fit_light": "what the fit leaves of the environment: squared, over the sphere, over the "
    "environment",
    "asset": "the relative L2 difference of the delivered pictures and the reference, over all "
    "validation pictures",
}
"""Kind of job -> what its points are compared by; of validation alone the noise is known."""
COLUMNS = ("error", "noise", "seconds", "shared_seconds", "check_seconds", "bytes",
           "peak_memory_bytes")  # fmt: skip
FILES = {
    "study.json": "application/json",
    "study.csv": "text/csv",
    "frontier.png": "image/png",
    "study.html": "text/html",
    "report.json": "application/json",
    "report.html": "text/html",
}


def task(gathered: dict[str, Any]) -> Task:
    """Write what `Study.gather` collected."""
    return Task(f"{_MODULE}:write", gathered, label="report")


def write(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: find the frontiers and write every form of the table."""
    study = compared(args)
    picture = frontier_png(study["points"], study["frontier"])
    data = json.dumps(study, indent=1, allow_nan=False).encode()
    contents = {
        "study.json": data,
        "study.csv": table(study).encode(),
        "frontier.png": picture,
        "study.html": study_page(study).encode(),
        "report.json": data,
        "report.html": study_page(study, picture).encode(),
    }
    return {
        "files": {name: context.store.put_bytes(content) for name, content in contents.items()},
        "summary": summary(study),
    }


def artefacts(written: Mapping[str, Any]) -> list[ArtefactFile]:
    """List the files."""
    return [ArtefactFile(name, FILES[name], digest) for name, digest in written["files"].items()]


def compared(gathered: Mapping[str, Any]) -> dict[str, Any]:
    """Mark the frontiers, and give every point the request that makes it alone."""
    known = [point for point in gathered["points"] if point["error"] is not None]
    frontier = {
        cost: [
            known[place]["point"]
            for place in pareto_frontier(
                [point[cost] for point in known], [point["error"] for point in known]
            )
        ]
        for cost in COSTS
    }
    points = [
        point
        | {
            "frontier": [cost for cost in COSTS if point["point"] in frontier[cost]],
            "request": laid_over(gathered["base"], point["values"]),
        }
        for point in gathered["points"]
    ]
    work = sum(stage["seconds"] for stage in gathered["stages"])
    alone = sum(point["seconds"] + point["check_seconds"] for point in points)
    skipped = f", {len(gathered['skipped'])} left out" if gathered["skipped"] else ""
    return {
        "title": gathered["title"],
        "summary": f"{len(points)} points of {gathered['kind']} jobs{skipped}: {work:.3g} s of "
        f"work, where the points by themselves would take {alone:.3g} s. "
        f"{len(frontier['seconds'])} stand on the frontier of error and seconds, "
        f"{len(frontier['bytes'])} on that of error and bytes.",
        "kind": gathered["kind"],
        "error_is": ERROR_IS[gathered["kind"]],
        "axes": gathered["axes"],
        "base": gathered["base"],
        "frontier": frontier,
        "points": points,
        "skipped": gathered["skipped"],
        "seconds": {"work": work, "alone": alone},
        "stages": [
            {name: value for name, value in stage.items() if name != "files"}
            for stage in gathered["stages"]
        ],
    }


def table(study: Mapping[str, Any]) -> str:
    """Write the points as CSV, those left out behind the others with the reason alone."""
    paths = [axis["path"] for axis in study["axes"]]
    stages = list(dict.fromkeys(name for point in study["points"] for name in point["stages"]))
    file = StringIO()
    rows = csv.writer(file, lineterminator="\n")
    rows.writerow(
        ["point", *paths, *COLUMNS, *(f"{cost}_frontier" for cost in COSTS),
         *(f"seconds_{name}" for name in stages), "skipped"]
    )  # fmt: skip
    for point in study["points"]:
        rows.writerow(
            [point["point"], *_cells(point["values"], paths),
             *("" if point[name] is None else point[name] for name in COLUMNS),
             *(int(cost in point["frontier"]) for cost in COSTS),
             *(point["stages"].get(name, {}).get("seconds", "") for name in stages), ""]
        )  # fmt: skip
    for point in study["skipped"]:
        blank = [""] * (len(COLUMNS) + len(COSTS) + len(stages))
        rows.writerow([point["point"], *_cells(point["values"], paths), *blank, point["reason"]])
    return file.getvalue()


def _cells(values: Mapping[str, Any], paths: Sequence[str]) -> list[str]:
    """Write values as JSON, but words as they are."""
    found = [values[path] for path in paths]
    return [value if isinstance(value, str) else json.dumps(value) for value in found]


def summary(study: Mapping[str, Any]) -> dict[str, Any]:
    """Give the part that a job carries as its result: the points of the frontiers."""
    names = ("point", "values", "error", "noise", "seconds", "shared_seconds", "bytes", "frontier")
    return {
        "summary": study["summary"],
        "error_is": study["error_is"],
        "points": len(study["points"]),
        "skipped": len(study["skipped"]),
        "frontier": [
            {name: point[name] for name in names} for point in study["points"] if point["frontier"]
        ],
        "seconds": {stage["name"]: stage["seconds"] for stage in study["stages"]}
        | {"total": study["seconds"]["work"]},
        "peak_memory_bytes": max(
            (stage["peak_memory_bytes"] for stage in study["stages"]), default=0
        ),
        "notes": notes(study),
    }


def notes(study: Mapping[str, Any]) -> list[str]:
    """Say what was left out, and which points cannot be compared."""
    found = [
        f"point {point['point']} was left out: {point['reason']}" for point in study["skipped"][:20]
    ]
    if (more := len(study["skipped"]) - 20) > 0:
        found.append(f"{more} more points were left out: study.csv lists them")
    black = [point["point"] for point in study["points"] if point["error"] is None]
    if black:
        found.append(f"points {black} have a black reference and no error: no frontier holds them")
    return found
