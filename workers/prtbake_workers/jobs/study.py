"""Job kind ``study``: a request at every point of a grid, and what its accuracy costs."""

from collections.abc import Callable, Mapping
from typing import Any

from prtbake_storage.contract.jobs import StudyPoint, StudyRequest
from prtbake_storage.contract.study import Values, describe
from prtbake_storage.queue.stages import Finished, Results, Stage, Task
from prtbake_workers.jobs import report, study_report
from prtbake_workers.jobs.shared_stages import Share, SharedStages
from prtbake_workers.planning.ladder_steps import CHECKS
from prtbake_workers.report.account import pooled_budget

Build = Callable[[dict[str, Any], dict[str, Any]], list[Stage]]

FILES = {
    "bake": ("join", "transfer.h5"),
    "compress": ("quantise", "asset.h5"),
    "fit_light": ("fit_light", "light.h5"),
    "asset": ("quantise", "asset.h5"),
}
"""Kind -> the stage that tells the size of its file, and the file's name."""


class Study:
    """The points of a study and their common stages."""

    def __init__(
        self, request: dict[str, Any], context: dict[str, Any], kinds: Mapping[str, Build]
    ) -> None:
        self.request = StudyRequest.model_validate(request)
        self.kind = self.request.base.kind
        self.points: list[StudyPoint] = []
        self.refused: list[tuple[StudyPoint, str]] = []
        jobs: list[list[Stage]] = []
        for point, place in zip(self.request.points(), context["points"], strict=True):
            if point.request is None or "refused" in place:
                self.refused.append((point, str(point.refused or place["refused"])))
                continue
            # what a clock cuts is taken up by points of this study alone
            own = context["contexts"][place["context"]] | {"started": context.get("started")}
            stages = kinds[self.kind](point.request.model_dump(mode="json"), own)
            self.points.append(point)
            jobs.append(stages)
        self.shared = SharedStages(
            jobs,
            [describe(point.values) for point in self.points],
            skip_refused=self.request.skip_illegal,
        )

    def gather(self, results: Results) -> dict[str, Any]:
        """Turn results into the arguments of the study's report: a pure function, without I/O."""
        shared = self.shared.shared_keys(results)
        refused = list(self.refused)
        points = []
        for point, share in zip(self.points, self.shared.shares(results), strict=True):
            if share.refused is not None:
                refused.append((point, share.refused))
            else:
                points.append(account(self.kind, point.index, point.values, share, shared))
        refused.sort(key=lambda pair: pair[0].index)
        return {
            "title": self.request.label or f"study of {self.kind} jobs",
            "kind": self.kind,
            "axes": [axis.model_dump(mode="json") for axis in self.request.axes],
            "base": self.request.model_dump(mode="json")["base"],
            "points": points,
            "skipped": [
                {"point": point.index, "values": point.values, "reason": reason}
                for point, reason in refused
            ],
            "stages": [report.stage_cost(name, results) for name in results],
        }


def account(
    kind: str, index: int, values: Values, share: Share, shared: set[str]
) -> dict[str, Any]:
    """Say what one point costs by itself, and its errors.

    ``seconds`` are those of all stages that make its file, with what it has in common with other
    points, ``shared_seconds``, in full; ``check_seconds`` those of pictures and validation.
    ``error`` is None where nothing can be said of it, and ``noise`` None where it has none.
    ``lines`` are those of the error budget of an asset, by name, and ``resolution`` the numbers
    that decide them (see `Resolution`); none of other kinds.
    """
    own = share.results
    plan = own["plan"][0].get("plan") if "plan" in own else None
    stages: dict[str, dict[str, float]] = {}
    errors: dict[str, dict[str, float]] = {}
    peak = 0
    for name in own:
        costs = list(zip(own.measured(name), share.keys[name], strict=True))
        stages[name] = {
            "seconds": sum((cost.seconds for cost, _ in costs), start=0.0),
            "shared_seconds": sum(
                (cost.seconds for cost, key in costs if key in shared), start=0.0
            ),
        }
        peak = max([peak, *(cost.peak_memory_bytes for cost, _ in costs)])
        if found := report.stage_account(name, own, plan)["errors"]:
            errors[name] = found
    making = [stage for name, stage in stages.items() if name not in CHECKS]
    error, noise, lines = _error(kind, own)
    stage, file = FILES[kind]
    return {
        "point": index,
        "values": values,
        "error": error,
        "noise": noise,
        "lines": lines,
        "resolution": plan["resolution"] if plan is not None and lines else {},
        "seconds": sum(stage["seconds"] for stage in making),
        "shared_seconds": sum(stage["shared_seconds"] for stage in making),
        "check_seconds": sum(stages[name]["seconds"] for name in CHECKS if name in stages),
        "bytes": own[stage][0]["bytes"],
        "file": file,
        "peak_memory_bytes": peak,
        "stages": stages,
        "errors": errors,
    }


def _error(kind: str, own: Results) -> tuple[float | None, float | None, dict[str, float]]:
    """Give the error that the frontier is of, its noise, its lines: see `study_report.ERROR_IS`."""
    match kind:
        case "compress":
            return own["quantise"][0]["delivered"]["error"], None, {}
        case "fit_light":
            return own["fit_light"][0]["errors"]["light"], None, {}
        case "bake":
            signal = sum(tile["held_out_signal"] for tile in own["bake"])
            left = sum(tile["held_out_residual"] for tile in own["bake"])
            return (left / signal if signal else 0.0), None, {}
    budget = pooled_budget([view for camera in own["validate"] for view in camera["views"]])
    if budget["black_reference"]:
        return None, None, {}
    lines = {line["name"]: line["error"] for line in budget["lines"]}
    return budget["total"], budget["total_noise"], lines


def stages(
    request: dict[str, Any], context: dict[str, Any], kinds: Mapping[str, Build]
) -> list[Stage]:
    """Run the points' stages side by side, then compare the points."""
    study = Study(request, context, kinds)

    def compare(results: Results) -> list[Task]:
        return [study_report.task(study.gather(results))]

    return [*study.shared.stages(), Stage("report", "report", 1.0, compare)]


def finish(results: Results) -> Finished:
    """Name the files and the summary."""
    (written,) = results["report"]
    return Finished(result=written["summary"], artefacts=study_report.artefacts(written))
