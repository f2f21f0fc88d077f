"""Stages of many jobs of one kind as those of one job: a task that several have is run once.

What a task gives depends on its arguments alone, so tasks of one key are one task.  Results are
then dealt out again: every job goes on as if it had run by itself.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from prtbake_storage.errors import InputError, SettingsError
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Round, Rounds, Stage, Task
from prtbake_workers.jobs import compress, cta_tiles, fit_light, plan

_MODULE = "prtbake_workers.jobs.shared_stages"
REFUSING = {
    "prtbake_workers.jobs.plan:plan": plan.plan,
    "prtbake_workers.jobs.compress:outline": compress.outline,
    "prtbake_workers.jobs.compress:compress_part": compress.compress_part,
    "prtbake_workers.jobs.cta_tiles:finish": cta_tiles.finish,
    "prtbake_workers.jobs.compress:assemble": compress.assemble,
    "prtbake_workers.jobs.fit_light:fit": fit_light.fit,
}
"""Tasks that refuse what only the inputs tell to be illegal, as an error that no sizes meet, or
registers that no cluster fits.

They run anew in a job of its own: planning, and the last of compression, which is quick, and what
is `LONG` only where it is given what it may refuse.
"""


def _registers(args: dict[str, Any]) -> bool:
    return "registers" in (args.get("draws") or {})


def _error_or_registers(args: dict[str, Any]) -> bool:
    return args["max_error"] is not None or _registers(args)


def _error_or_bytes(args: dict[str, Any]) -> bool:
    return any(args["settings"].get(name) is not None for name in ("max_error", "max_bytes"))


LONG: dict[str, Callable[[dict[str, Any]], bool]] = {
    "prtbake_workers.jobs.compress:compress_part": _error_or_registers,
    "prtbake_workers.jobs.cta_tiles:finish": _registers,
    "prtbake_workers.jobs.fit_light:fit": _error_or_bytes,
}
"""Of these, tasks that refuse nothing but what some are given, by what tells it from arguments."""


@dataclass
class Share:
    """One job's part: its own results, the keys of its tasks by stage, and why it was given up."""

    results: Results = field(default_factory=Results)
    keys: dict[str, list[str]] = field(default_factory=dict)
    refused: str | None = None


class SharedStages:
    """The stages of several jobs, side by side.

    Parameters
    ----------
    jobs
        The stages of each.  All jobs have them in the same order; a job may lack some.
    names
        What sentences call each job.
    skip_refused
        Go on without jobs that a task of theirs refuses, instead of failing with its error.
    """

    def __init__(
        self, jobs: Sequence[Sequence[Stage]], names: Sequence[str], *, skip_refused: bool
    ) -> None:
        self._jobs = [{stage.name: stage for stage in stages} for stages in jobs]
        self._order = merged([[stage.name for stage in stages] for stages in jobs])
        self._names, self._skip_refused = names, skip_refused
        # what was dealt out of the results that were asked about last: these only ever grow
        self._seen: Results | None = None
        self._shares: list[Share] = []
        self._dealt = self._rounds_dealt = 0
        self._listed: dict[str, list[list[Task]]] = {}

    def stages(self) -> list[Stage]:
        """List the common stages."""
        return [self._stage(name) for name in self._order]

    def shares(self, results: Results) -> list[Share]:
        """Deal out what the common stages have left so far.

        Raises
        ------
        InputError
            Naming the job, where a task refused it and refused ones are not skipped, or where all
            are refused.
        """
        if results is not self._seen:
            self._seen, self._dealt, self._rounds_dealt = results, 0, 0
            self._shares = [Share() for _ in self._jobs]
            self._listed = {}
        try:
            while self._dealt < len(self._order):
                name = self._order[self._dealt]
                for done in results.rounds(name)[self._rounds_dealt :]:
                    self._deal(name, done)
                    self._rounds_dealt += 1
                if name not in results:
                    break
                self._close(name)
                self._dealt, self._rounds_dealt = self._dealt + 1, 0
        except InputError:
            self._seen = None  # a stage is half dealt out
            raise
        return self._shares

    def shared_keys(self, results: Results) -> set[str]:
        """Find the tasks that more than one job uses."""
        uses: Counter[str] = Counter()
        for share in self.shares(results):
            uses.update({key for keys in share.keys.values() for key in keys})
        return {key for key, count in uses.items() if count > 1}

    def _stage(self, name: str) -> Stage:
        model = next(stages[name] for stages in self._jobs if name in stages)

        def tasks(results: Results) -> list[Task]:
            once: dict[str, Task] = {}
            shares = self.shares(results)
            self._listed[name] = self._tasks(name, shares)
            for own in self._listed[name]:
                for task in own:
                    once.setdefault(task.key, task)
            return list(once.values())

        return Stage(name, model.unit, model.weight, tasks, self._rounds(name))

    def _rounds(self, name: str) -> Rounds | None:
        """Repeat as long as any job does."""
        known = [stages[name].rounds if name in stages else None for stages in self._jobs]
        if not any(known):
            return None

        def most(results: Results) -> int:
            shares = zip(known, self.shares(results), strict=True)
            return max(
                own.most(share.results) if own and share.refused is None else 1
                for own, share in shares
            )

        def outcome(results: Results) -> list[dict[str, Any]]:
            return [value for done in results.rounds(name) for value in done.values]

        return Rounds(most, outcome)

    def _tasks(self, name: str, shares: Sequence[Share]) -> list[list[Task]]:
        return [
            [attempted(task) for task in stages[name].tasks(share.results)]
            if name in stages and name not in share.results and share.refused is None
            else []
            for stages, share in zip(self._jobs, shares, strict=True)
        ]

    def _close(self, name: str) -> None:
        """Give the jobs whose stage repeats its results."""
        self._listed.pop(name, None)
        for stages, share in zip(self._jobs, self._shares, strict=True):
            rounds = stages[name].rounds if name in stages else None
            if rounds is not None and share.refused is None:
                share.results.close(name, rounds.outcome(share.results))

    def _deal(self, name: str, done: Round) -> None:
        tasks = self._listed.pop(name, None) or self._tasks(name, self._shares)
        place: dict[str, int] = {}
        for own in tasks:
            for task in own:
                place.setdefault(task.key, len(place))
        for job, (share, own) in enumerate(zip(self._shares, tasks, strict=True)):
            if share.refused is not None or name not in self._jobs[job] or name in share.results:
                continue
            if not own and share.results.rounds(name):
                continue  # it needs fewer rounds than others
            keys = [task.key for task in own]
            share.keys.setdefault(name, []).extend(keys)
            found = [done.values[place[key]] for key in keys]
            refused = next((value["refused"] for value in found if "refused" in value), None)
            if refused is not None:
                self._refuse(job, refused)
                continue
            repeats = self._jobs[job][name].rounds is not None
            (share.results.add_round if repeats else share.results.add)(
                name,
                [value.get("attempted", value) for value in found],
                [done.measured[place[key]] for key in keys],
            )
        if all(share.refused is not None for share in self._shares):
            raise SettingsError(f"no point can be run: {self._shares[0].refused}")

    def _refuse(self, job: int, refused: dict[str, Any]) -> None:
        if not self._skip_refused:
            detail = f"point of {self._names[job]}: {refused['detail']}"
            raise SettingsError(detail, pointer=refused["pointer"])
        self._shares[job].refused = refused["detail"]


def merged(lists: Sequence[Sequence[str]]) -> list[str]:
    """Merge lists of names into one that has each list's names in its order.

    Raises
    ------
    ValueError
        Where two lists have two names in different orders.
    """
    order: list[str] = []
    for names in lists:
        at = 0
        for name in names:
            if name not in order:
                order.insert(at, name)
            elif order.index(name) < at:
                raise ValueError(f"stage {name!r} stands at different places")
            at = order.index(name) + 1
    return order


def attempted(task: Task) -> Task:
    """Turn a task that may refuse into one whose refusal is a result and not the job's end."""
    may_refuse = LONG.get(task.function)
    if task.function not in REFUSING or (may_refuse is not None and not may_refuse(task.args)):
        return task
    args = {"function": task.function, "args": task.args}
    return replace(task, function=f"{_MODULE}:attempt", args=args)


def attempt(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: do what another does, or say why it refuses."""
    try:
        return {"attempted": REFUSING[args["function"]](args["args"], context)}
    except InputError as error:
        return {"refused": {"detail": error.detail, "pointer": error.pointer}}
