"""A job with a budget, ``asset`` or ``bake``: a search for what it is made of, then its report."""

from typing import Any

from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.jobs import report
from prtbake_workers.jobs.bake_budget import BakeSearch
from prtbake_workers.jobs.error_budget import ErrorSearch
from prtbake_workers.jobs.search_stages import account
from prtbake_workers.jobs.sized_asset import SizedAsset
from prtbake_workers.jobs.time_budget import TimeSearch
from prtbake_workers.jobs.work import learnt


def has_one(kind: str, request: dict[str, Any]) -> bool:
    """Tell whether a request is of an asset or a bake with a budget."""
    return kind in ("asset", "bake") and request.get("budget") is not None


def search_of(
    request: dict[str, Any], context: dict[str, Any]
) -> ErrorSearch | TimeSearch | SizedAsset | BakeSearch:
    """Make the search that a budget calls for."""
    if request.get("kind") == "bake":
        return BakeSearch(request, context)
    if request["budget"].get("max_error") is not None:
        return ErrorSearch(request, context)
    if request["budget"].get("max_seconds") is not None:
        return TimeSearch(request, context)
    return SizedAsset(request, context)


def stages(title: str, request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    """List the stages of the search and its report."""
    search = search_of(request, context)

    def write(results: Results) -> list[Task]:
        seen = search.delivered(results)
        predicted = search.predicted(results) if isinstance(search, SizedAsset) else {}
        args = report.gather(title, seen, predicted)
        args["search"] = {
            "budget": request["budget"],
            "aim": search.aim(results),
            "attempts": account(search.tried(results), results),
        }
        args["asset_notes"] = [*args["asset_notes"], *_notes(request["budget"], seen)]
        if isinstance(search, BakeSearch):
            args["search"] |= search.account(results)
        own = {stage["name"] for stage in args["stages"]}
        args["stages"] += [
            report.stage_cost(name, results) | {"predicted_seconds": None, "errors": {}}
            for name in results
            if name not in own and results[name] and not search.is_delivered(name, results)
        ]
        return [report.task(args)]

    return [*search.stages(), Stage("report", "report", 1.0, write)]


def _notes(budget: dict[str, Any], seen: Results) -> list[str]:
    """Say what came of the bytes, where cutting the file to them does not say it itself."""
    most = budget.get("max_bytes")
    if most is None or "quantise" not in seen:
        return []
    (written,) = seen["quantise"]
    taken = f"asset.h5 takes {written['bytes']} of {most} bytes"
    return [] if any(note.startswith(taken) for note in written["notes"]) else [taken]


def finish(request: dict[str, Any], context: dict[str, Any], results: Results) -> Finished:
    """Name the files and the summary that the search left."""
    search = search_of(request, context)
    seen = search.delivered(results)
    # a job that made nothing in vain is as good a teacher as one without a budget
    rates = learnt("asset", seen, context) if isinstance(search, SizedAsset) else None
    return Finished(result=report.summary(seen), artefacts=report.artefacts(seen), rates=rates)
