"""An ``asset`` job with a budget: a search for what it is made of, then its report."""

from typing import Any

from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.jobs import report
from prtbake_workers.jobs.error_budget import ErrorSearch
from prtbake_workers.jobs.search_stages import account
from prtbake_workers.jobs.time_budget import TimeSearch


def has_one(kind: str, request: dict[str, Any]) -> bool:
    """Tell whether a request is of an asset with a budget."""
    return kind == "asset" and request.get("budget") is not None


def search_of(request: dict[str, Any], context: dict[str, Any]) -> ErrorSearch | TimeSearch:
    """Make the search that a budget calls for."""
    if request["budget"].get("max_error") is None:
        return TimeSearch(request, context)
    return ErrorSearch(request, context)


def stages(title: str, request: dict[str, Any], context: dict[str, Any]) -> list[Stage]:
    """List the stages of the search and its report."""
    search = search_of(request, context)

    def write(results: Results) -> list[Task]:
        seen = search.delivered(results)
        args = report.gather(title, seen)
        args["search"] = {
            "budget": request["budget"],
            "aim": search.aim(results),
            "attempts": account(search.tried(results), results),
        }
        own = {stage["name"] for stage in args["stages"]}
        args["stages"] += [
            report.stage_cost(name, results) | {"predicted_seconds": None, "errors": {}}
            for name in results
            if name not in own and results[name] and not search.is_delivered(name, results)
        ]
        return [report.task(args)]

    return [*search.stages(), Stage("report", "report", 1.0, write)]


def finish(request: dict[str, Any], context: dict[str, Any], results: Results) -> Finished:
    """Name the files and the summary that the search left."""
    seen = search_of(request, context).delivered(results)
    return Finished(result=report.summary(seen), artefacts=report.artefacts(seen))
