"""The last stage of every job: ``report.json``, and ``report.html`` with the pictures."""

import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from prtbake_storage.blobs.base import referenced_digests
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import ArtefactFile, Results, Stage, Task
from prtbake_workers.jobs import bounce
from prtbake_workers.planning.ladder_steps import making_seconds
from prtbake_workers.planning.rates import Rates
from prtbake_workers.report import steps
from prtbake_workers.report.account import (
    StageAccount,
    make_report,
    part_accounts,
    pooled_budget,
    projection_errors,
)
from prtbake_workers.report.frontier_picture import frontier_png
from prtbake_workers.report.html import report_page

_MODULE = "prtbake_workers.jobs.report"
TILE_FIGURES = (
    "signal", "residual", "rounding", "held_out_signal", "held_out_residual", "counters",
)  # fmt: skip


def stage(title: str, predicted: Callable[[Results], Mapping[str, float]] = lambda _: {}) -> Stage:
    """Gather what the stages before left, whichever they were; ``predicted`` are their seconds."""

    def report(results: Results) -> list[Task]:
        return [task(gather(title, results, predicted(results)))]

    return Stage("report", "report", 1.0, report)


def task(args: dict[str, Any]) -> Task:
    """Make the task that writes what was gathered."""
    return Task(f"{_MODULE}:write", args, label="report")


def gather(
    title: str, results: Results, predicted: Mapping[str, float] = MappingProxyType({})
) -> dict[str, Any]:
    """Turn results into the arguments of the report: a pure function, without I/O."""
    plan = results["plan"][0]["plan"] if "plan" in results else None
    return {
        "title": title,
        "stages": [stage_account(name, results, plan, predicted) for name in results],
        "plan": plan,
        "tiles": [
            {name: tile[name] for name in TILE_FIGURES}
            for tile in results.get("bake", [])
        ],
        # every block traces the same rays: those of one are told
        "bounce_counters": results["bounces"][0]["counters"] if results.get("bounces") else {},
        "compressed": [
            {
                name: part[name]
                for name in (
                    "method", "clusters", "objective", "factor_bytes", "transfer_bytes", "notes",
                    "overdraw",
                )
            }
            for part in results.get("compress", [])
        ],
        "precision": results["quantise"][0]["precision"] if "quantise" in results else [],
        "overdraw": results["quantise"][0]["overdraw"] if "quantise" in results else None,
        "superclusters": results["quantise"][0]["superclusters"] if "quantise" in results else [],
        "asset_notes": results["quantise"][0]["notes"] if "quantise" in results else [],
        "views": [view for camera in results.get("validate", []) for view in camera["views"]],
        "previews": results["render"][0]["pictures"] if "render" in results else [],
        "renderer": results["render"][0]["renderer"] if "render" in results else None,
        "numerics": _numerics(results),
        "transfer": results["plan"][0].get("transfer") if "plan" in results else None,
        "bounces": bounce.account(results, plan) if plan else None,
        "bounce_notes": bounce.scattering_notes(results, plan) + bounce.notes(results, plan)
        if plan
        else [],
        "light_notes": results["fit_light"][0]["notes"] if "fit_light" in results else [],
        "settings": results["plan"][0].get("settings", {}) if "plan" in results else {},
        "ladder": _ladder(results, plan),
        "sizes": {
            f"{name}.h5": results[stage][0]["bytes"]
            for stage, name in (("join", "transfer"), ("quantise", "asset"), ("fit_light", "light"))
            if stage in results
        },
    }  # fmt: skip


def _ladder(results: Results, plan: dict[str, Any] | None) -> list[dict[str, Any]]:
    """Say what the qualities beside an asset's own are predicted to cost, and this one did."""
    if plan is None or not plan.get("ladder") or "quantise" not in results:
        return []
    measured = {name: stage_cost(name, results)["seconds"] for name in results}
    own = {
        "quality": None,
        # as those beside it: by the rates that are shipped
        "seconds": making_seconds(Rates().all_seconds(plan["work"])),
        "asset_bytes": plan["artefact_bytes"]["asset.h5"],
        "terms": [part["n_terms"] for part in plan["parts"]],
        "error_factors": {},
        "measured_seconds": making_seconds(measured),
        "measured_bytes": results["quantise"][0]["bytes"],
    }
    others = [step | {"measured_seconds": None, "measured_bytes": None} for step in plan["ladder"]]
    return sorted([own, *others], key=lambda step: step["seconds"])


def _numerics(results: Results) -> dict[str, Any]:
    """Collect what says how well conditioned the job was."""
    numerics: dict[str, Any] = {}
    if "plan" in results and "condition" in results["plan"][0]:
        numerics["gram_condition"] = results["plan"][0]["condition"]
    if "bake" in results:
        numerics["ray_offset"] = max(tile["epsilon"] for tile in results["bake"])
        numerics["gram_defect_of_directions"] = max(t["gram_defect"] for t in results["bake"])
    if "fit_light" in results:
        (light,) = results["fit_light"]
        names = ("light_method", "light_numbers", "lobes", "negative_lobes", "power_ratio")
        numerics |= {name: light[name] for name in names if name in light}
    return numerics


def stage_account(
    name: str,
    results: Results,
    plan: dict[str, Any] | None,
    predicted: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Any]:
    """Give one stage's cost, predicted and measured, its own errors and the files that it left."""
    errors: dict[str, float] = {}
    for result in results[name]:
        errors |= result.get("errors", {})
    if name == "bake" and plan is not None:
        errors = projection_errors(plan["parts"], results["bake"])
    if name == "bounces":
        errors = bounce.errors(results)
    seconds = predicted.get(name)
    return stage_cost(name, results) | {"predicted_seconds": seconds, "errors": errors}


def stage_cost(name: str, results: Results) -> dict[str, Any]:
    """Give what one stage cost, and the files that it left."""
    measured = results.measured(name)
    return {
        "name": name,
        "tiles": len(measured),
        "seconds": sum((one.seconds for one in measured), start=0.0),
        "peak_memory_bytes": max((one.peak_memory_bytes for one in measured), default=0),
        "files": sorted(set(referenced_digests(results[name]))),
    }


def write(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: write the report as JSON and as a page."""
    plan = args["plan"] or {"parts": [], "effects": [], "notes": []}
    counters: dict[str, int | float] = {}
    for tile in args["tiles"]:
        for name, value in tile["counters"].items():
            counters[name] = counters.get(name, 0) + value
    counters |= args["bounce_counters"]
    names = [part["name"] for part in plan["parts"]]
    basis = (args["transfer"] or {}).get("basis", "srbf")
    notes = [*plan["notes"], *large_errors(args["stages"], names, basis)]
    for part in args["compressed"]:
        notes += part["notes"]
    notes += args["bounce_notes"]
    notes += args["light_notes"]
    notes += args["asset_notes"]
    if args["renderer"] is not None and args["renderer"]["backend"] != "egl":
        notes.append(f"previews by the CPU renderer: {args['renderer']['reason']}")
    budget = pooled_budget(args["views"]) if args["views"] else None
    own_frontier = steps.frontier(args["ladder"], budget)
    report = make_report(
        title=args["title"],
        stages=[
            StageAccount(
                **{name: value for name, value in stage.items() if name != "files"},
                bytes=sum(context.store.size(digest) for digest in stage["files"]),
            )
            for stage in args["stages"]
        ],
        parts=part_accounts(
            plan["parts"], args["compressed"], args["precision"], args["superclusters"]
        )
        if args["compressed"]
        else [],
        effects=plan["effects"],
        views=args["views"],
        sizes=args["sizes"],
        renderer=args["renderer"],
        counters=counters,
        numerics=args["numerics"],
        transfer=args["transfer"],
        bounces=args["bounces"],
        settings=args["settings"],
        ladder=args["ladder"],
        frontier=own_frontier,
        search=args.get("search"),
        notes=notes,
        overdraw=args["overdraw"],
    )
    pictures = {
        picture["name"]: context.store.read_bytes(picture["digest"])
        for picture in args["previews"]
        if picture["media_type"] == "image/png" and picture["name"].startswith("preview")
    }
    for view in args["views"]:
        for name, digest in view["pictures"].items():
            pictures[f"{name.removesuffix('.png')}: reference, asset, difference"] = (
                context.store.read_bytes(digest)
            )
    plot = frontier_png(*steps.drawn(own_frontier)) if own_frontier else None
    page = report_page(report, pictures, plot)
    return {
        "report": report,
        "json": context.store.put_bytes(json.dumps(report, indent=1).encode()),
        "html": context.store.put_bytes(page.encode()),
    }


LARGE_ERROR = 0.1
"""Squared-error ratio of a stage's own from which the report says so: a third of the radiance."""

BASIS_REMEDIES = {
    "srbf": "SRBFs leave {:.0%} of its transport: more n_centres, or a higher quality",
    "sh": "spherical harmonics leave {:.0%} of its transport: a higher sh_order or quality, or "
    "basis srbf",
}
REMEDIES = {
    "compress": "clusters and ranks leave {:.0%} of its transfer: more n_clusters, higher ranks, "
    "or a higher quality",
}


def large_errors(stages: list[dict[str, Any]], names: list[str], basis: str = "srbf") -> list[str]:
    """Point to parts that a stage lost much of: a brighter part may hide it in the pictures."""
    remedies = REMEDIES | {"bake": BASIS_REMEDIES[basis]}
    return [
        f"{name}: {remedies[stage['name']].format(error)}"
        for stage in stages
        if stage["name"] in remedies
        for name, error in stage["errors"].items()
        if error > LARGE_ERROR and name in names
    ]


def artefacts(results: Results) -> list[ArtefactFile]:
    """List every file that the stages left."""
    files = [
        ArtefactFile(f"{name}.h5", "application/x-hdf5", results[stage][0][key])
        for stage, name, key in (
            ("join", "transfer", "transfer"),
            ("quantise", "asset", "asset"),
            ("quantise", "asset-float32", "exact"),
            ("fit_light", "light", "light"),
        )
        if stage in results
    ]
    if "render" in results:
        files += [
            ArtefactFile(picture["name"], picture["media_type"], picture["digest"])
            for picture in results["render"][0]["pictures"]
        ]
    for camera in results.get("validate", []):
        for view in camera["views"]:
            files += [
                ArtefactFile(f"validation-{name}", "image/png", digest)
                for name, digest in view["pictures"].items()
            ]
    (report,) = results["report"]
    return [
        *files,
        ArtefactFile("report.json", "application/json", report["json"]),
        ArtefactFile("report.html", "text/html", report["html"]),
    ]


def summary(results: Results) -> dict[str, Any]:
    """Give the part of the report that a job carries as its result."""
    (written,) = results["report"]
    report = written["report"]
    names = ("summary", "errors", "budget", "bytes", "seconds", "effects", "metrics", "parts",
             "overdraw", "peak_memory_bytes", "renderer", "transfer", "numerics", "counters",
             "search", "notes")  # fmt: skip
    return {name: report[name] for name in names}
