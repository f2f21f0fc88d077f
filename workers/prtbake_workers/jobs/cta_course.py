"""The rounds of a compress stage: which tasks of which part come next.

A part in one task has one round.  A tensor approximation whose steps are shared has a start, rounds
of steps as its schedule has them, and a finish.  All of it follows from the results so far.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

from prtbake_storage.queue.stages import Round, Task
from prtbake_workers.compress.cta_schedule import APPROXIMATION_ITERATIONS, Schedule, Step

_MODULE = "prtbake_workers.jobs.cta_tiles"

STEPS = {
    Step.MODEL: "model", Step.CLASSIFY: "classify", Step.VIEW: "view", Step.FIT: "approximate",
}  # fmt: skip


def most_rounds(max_iterations: int) -> int:
    """Count the rounds of a fit that ends by its limits: start, steps, and finish."""
    return 2 + (2 * max_iterations - 1) + 2 * APPROXIMATION_ITERATIONS


def shares(n_clusters: int, n_tasks: int) -> list[tuple[int, int]]:
    """Cut clusters into runs [start, stop) for so many tasks, none empty."""
    n_tasks = min(n_tasks, n_clusters)
    ends = [n_clusters * index // n_tasks for index in range(n_tasks + 1)]
    return list(pairwise(ends))


class OneTask:
    """A part that is compressed in one task."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self.result: dict[str, Any] | None = None

    def tasks(self) -> list[Task]:
        """List what it has to do next."""
        return [self._task] if self.result is None else []

    def take(self, values: Sequence[dict[str, Any]]) -> None:
        """Go on with the results of these tasks."""
        if values:
            (self.result,) = values


class SharedSteps:
    """A part whose tensor approximation is shared by so many tasks a step.

    ``whole`` is the task that would make it by itself.
    """

    def __init__(self, whole: Task, n_tasks: int) -> None:
        self._whole, self._n_tasks = whole, n_tasks
        self._started: dict[str, Any] | None = None
        self._models: list[str] = []
        self._moves: list[str] = []
        self._views: list[str] = []
        self.result: dict[str, Any] | None = None

    def tasks(self) -> list[Task]:
        """List what it has to do next."""
        if self.result is not None:
            return []
        if self._started is None:
            return [self._task("start", {})]
        state = {"started": self._started, "models": self._models}
        step = self._schedule.step
        if step is Step.END:
            return [self._task("finish", {**state, "objective": self._schedule.trace.values})]
        if step is Step.MODEL:
            state["moves"] = self._moves
        if step is Step.FIT:
            state["views"] = self._views
        return [
            self._task(STEPS[step], {**state, "clusters": [start, stop]}, f" {start}-{stop}")
            for start, stop in shares(self._started["n_clusters"], self._n_tasks)
        ]

    def take(self, values: Sequence[dict[str, Any]]) -> None:
        """Go on with the results of these tasks.

        Raises
        ------
        ObjectiveRose
            A step made the error larger.
        """
        if not values:
            return
        if self._started is None:
            (self._started,) = values
            norm = self._started["squared_norm"]
            self._schedule = Schedule(norm, self._whole.args["max_iterations"])
            return
        match self._schedule.step:
            case Step.MODEL | Step.FIT:
                self._models = [value["model"] for value in values]
                self._schedule.modelled(one for value in values for one in value["objectives"])
            case Step.CLASSIFY:
                self._moves = [value["moves"] for value in values]
                self._schedule.moved(sum(value["moved"] for value in values))
            case Step.VIEW:
                self._views = [value["view"] for value in values]
                self._schedule.seen()
            case Step.END:
                (self.result,) = values

    def _task(self, name: str, args: dict[str, Any], which: str = "") -> Task:
        return Task(
            f"{_MODULE}:{name}",
            {**self._whole.args, **args},
            label=f"{self._whole.label} {name}{which}",
            threads=self._whole.threads,
            settings_at=self._whole.settings_at,
        )


def course(
    wholes: Sequence[Task], n_tasks: Sequence[int], rounds: Sequence[Round]
) -> list[OneTask | SharedSteps]:
    """Return where the parts of a stage are after some rounds.

    ``wholes`` are the tasks that would compress each part by themselves, and ``n_tasks`` those that
    share each of its steps, 1 for none.
    """
    parts = [
        OneTask(whole) if number == 1 else SharedSteps(whole, number)
        for whole, number in zip(wholes, n_tasks, strict=True)
    ]
    for done in rounds:
        left: Iterator[dict[str, Any]] = iter(done.values)
        for part in parts:
            part.take([next(left) for _ in part.tasks()])
    return parts
