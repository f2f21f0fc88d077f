"""What searches for a budget have in common: attempts as stages, seen each as a job of its own.

A search lists the stages of as many attempts as it may ever make.  Which of them have tasks follows
from what the attempts before measured; the others are empty, and pass in a moment.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs import leaving
from prtbake_workers.jobs.work import slots_of, wall_seconds
from prtbake_workers.planning.rates import BETWEEN_STAGES_S
from prtbake_workers.planning.time_search import kept_for
from prtbake_workers.report.account import pooled_budget

BAKE = ("plan", "bake", "scattering", "bounces", "add_bounces", "join")
"""Stages from a request to its transfer."""

MADE = (*BAKE, "fit_light", "compress", "quantise")
"""Stages that make an asset."""

AFTER = ("render", "validate", "report")
"""Stages that come after a search."""


def numbered(name: str, attempt: int) -> str:
    """Name a stage of an attempt, which count from 0, for people, who count from 1."""
    return f"{name} {attempt + 1}"


def view(results: Results, names: Mapping[str, str]) -> Results:
    """Give some finished stages under other names: ``names`` are theirs by those that they get."""
    seen = Results()
    for name, own in names.items():
        if own in results:
            seen.add(name, results[own], results.measured(own), recalled=results.recalled(own))
    return seen


def attempt_view(results: Results, attempt: int, names: Iterable[str] = BAKE) -> Results:
    """Give an attempt's finished stages as if it were alone."""
    return view(results, {name: numbered(name, attempt) for name in names})


def held_predictions(planned: dict[str, Any], most: int | None) -> dict[str, Any]:
    """Hold what a plan's result predicts of ``asset.h5``, here and beside, against its bytes."""
    if most is None:
        return planned
    plan = planned["plan"]
    files = plan["artefact_bytes"]
    ladder = [step | {"asset_bytes": min(step["asset_bytes"], most)} for step in plan["ladder"]]
    held = {"artefact_bytes": files | {"asset.h5": min(files["asset.h5"], most)}, "ladder": ladder}
    return planned | {"plan": plan | held}


def unshared(planned: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Give the compression of each part, its steps in one task: an attempt has no rounds."""
    return [part["compression"] | {"tasks": 1} for part in planned["parts"]]


def done(values: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give the results of tasks that might have refused, and did not."""
    return [value.get("attempted", value) for value in values]


def refusal(results: Results, stage: str) -> dict[str, Any] | None:
    """Say why a task of a stage refused, if one did."""
    return next((value["refused"] for value in results.get(stage, []) if "refused" in value), None)


def refuse_as(refused: Mapping[str, Any]) -> NoReturn:
    """Refuse a job for what a task of an attempt refused; bytes are those of the budget.

    Raises
    ------
    SettingsError
        Always.
    """
    pointer = refused["pointer"]
    if (pointer or "").endswith("/compress/max_bytes"):
        pointer = "/budget/max_bytes"
    raise SettingsError(refused["detail"], pointer=pointer)


def views_of(results: Results, stage: str) -> list[dict[str, Any]] | None:
    """Give what a stage measured, view by view; None where it has not, or was late."""
    if not (cameras := results.get(stage)) or any("late" in one for one in cameras):
        return None
    return [view for camera in cameras for view in camera["views"]]


def held_out(results: Results, stage: str) -> float | None:
    """Give the error of a finished validation, 0 where there is nothing to be relative to."""
    if not (cameras := results.get(stage)):
        return None
    budget = pooled_budget([view for camera in cameras for view in camera["views"]])
    total: float = budget["total"]
    return 0.0 if budget["black_reference"] else total


def is_late(results: Results) -> bool:
    """Tell whether a task of these left because its time was out."""
    return any(value.get("late") for name in results for value in results[name])


def limit(
    stage: Stage, until: Callable[[Results], float | None], context: Mapping[str, Any]
) -> Stage:
    """Make the tasks of a stage leave when ``until`` says; None lets them take their time.

    A task that starts late still starts: those before it leave earlier by as much, as they start
    one after another in the slots of the job's ``context``.
    """
    slots = slots_of(context)

    def tasks(results: Results) -> list[Task]:
        listed = stage.tasks(results)
        when = until(results) if listed else None
        if when is None:
            return listed
        starts = [(len(listed) - 1 - place) // slots for place in range(len(listed))]
        return [
            leaving.until(task, when - after * kept_for(BETWEEN_STAGES_S))
            for task, after in zip(listed, starts, strict=True)
        ]

    return replace(stage, tasks=tasks)


def check_least(
    seconds: float, work: Mapping[str, Mapping[str, float]], context: Mapping[str, Any], least: str
) -> None:
    """Refuse a time that the least there is does not fit into.

    Raises
    ------
    SettingsError
        With what that is predicted to take.
    """
    needed = wall_seconds(work, context, list(work))
    if needed > seconds:
        raise SettingsError(
            f"{seconds:g} s are too few: quality {least}, the least there is, is predicted to take "
            f"{needed:.0f} s",
            pointer="/budget/max_seconds",
        )


@dataclass(frozen=True)
class Tried:
    """An attempt: what it errs by, whether it is in what is delivered, and why it is or not."""

    name: str
    error: float | None
    taken: bool
    why: str
    stages: tuple[str, ...]


FILES = ("join", "quantise", "fit_light")
"""Stages that tell the size of their file."""


def account(tried: Iterable[Tried], results: Results) -> list[dict[str, Any]]:
    """Say of every attempt what it erred by, took and weighed, and why it was taken or left."""
    listed = []
    for one in tried:
        files = [name for name in one.stages if name.split()[0] in FILES and results.get(name)]
        listed.append(
            {
                "name": one.name,
                "error": one.error,
                "seconds": seconds_of(results, one.stages),
                "bytes": done(results[files[-1]])[0].get("bytes") if files else None,
                "taken": one.taken,
                "why": one.why,
            }
        )
    return listed


def seconds_of(results: Results, names: Iterable[str]) -> float:
    """Add up what the tasks of some stages took."""
    return sum(
        (cost.seconds for name in names if name in results for cost in results.measured(name)),
        start=0.0,
    )
