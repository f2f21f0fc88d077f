"""A ``bake`` job with a budget: a trial of the scene, then bakes until one keeps what is asked.

The trial predicts what every choice of centres, directions and terms would leave, weigh and take.
One is baked; what it says of itself corrects the predictions, and another is baked where it does
not keep the budget, or leaves more of it than it need.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite, sqrt
from typing import Any, NoReturn

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.jobs import BakeRequest
from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs import bake, bake_trial, clock
from prtbake_workers.jobs.bake_lines import account_of, finite, lines_of, told_of
from prtbake_workers.jobs.search_stages import (
    BAKE,
    Tried,
    attempt_view,
    is_late,
    limit,
    numbered,
    view,
)
from prtbake_workers.jobs.work import wall_seconds
from prtbake_workers.percent import percent
from prtbake_workers.planning.bake_model import BakeModel, Numbers, Told, Work
from prtbake_workers.planning.bake_search import MOST_BAKES, choose, delivered, meets
from prtbake_workers.planning.later_stages import REPORT_WORK
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.time_search import kept_for, off_by

MOST_BOUNCES = 16
"""Where an error decides how much the last may add: where few rays make bounces grow, as between
glossy parts, more of them would only grow further."""


@dataclass
class Trail:
    """Where a search stands: numbers of bakes, the one under way last unless it is over."""

    numbers: list[Numbers] = field(default_factory=list)
    told: list[Told] = field(default_factory=list)
    over: bool = False
    late: bool = False
    delivered: int | None = None


@dataclass(frozen=True)
class First:
    """The bake that a search begins with, and what it is predicted to leave and to weigh.

    ``projection`` are squared-error ratios of each part, ``error`` is the relative L2 error of the
    part that it is largest of.
    """

    settings: StageSettings
    names: tuple[str, ...]
    projection: tuple[float, ...]
    error: float
    size: int


class BakeSearch:
    """The search of one job."""

    def __init__(self, request: dict[str, Any], context: dict[str, Any]) -> None:
        self._request, self._context = request, context
        self._parsed = BakeRequest.model_validate(request)
        if self._parsed.budget is None:
            raise ValueError("a search for a budget needs one")
        self._budget = self._parsed.budget
        self._given = self._parsed.settings.model_dump(mode="json", exclude_unset=True)
        self._made: dict[Numbers, dict[str, Stage]] = {}
        self._known: tuple[dict[str, Any], BakeModel] | None = None

    # decisions

    def trail(self, results: Results) -> Trail:
        """Go through the decisions again, from what was measured.

        Raises
        ------
        SettingsError
            Nothing keeps the budget; it tells the best that can be and what binds.
        """
        trail = Trail()
        if is_late(view(results, {"trial": "trial"})):
            words = "s are too few: they were out before the trial was made"
            self._refuse("max_seconds", f"{self._budget.max_seconds:g} {words}")
        elapsed = self._elapsed(results, "clock")
        if not results.get("trial") or elapsed is None:
            return trail
        model = self._model(results["trial"][0])
        while not trail.over:
            choice = choose(
                model,
                self._budget,
                trail.told,
                left=self._left(elapsed, model, trail.told),
                tolerance=self._tolerance,
            )
            trail.delivered = delivered(model, self._budget, trail.told)
            if choice.refused is not None:
                self._refuse(*choice.refused)
            if choice.numbers is None:
                trail.over = True
                break
            trail.numbers.append(choice.numbers)
            attempt = len(trail.told)
            own = attempt_view(results, attempt)
            if is_late(own):
                trail.over = trail.late = True
                if trail.delivered is None:
                    self._refuse("max_seconds", self.too_late(trail.told))
                break
            before, now = elapsed, self._elapsed(results, numbered("clock", attempt))
            if not own.get("join") or now is None:
                break
            elapsed = now
            trail.told.append(told_of(own, choice.numbers, max(now - before, 0.0)))
        return trail

    def _model(self, trial: dict[str, Any]) -> BakeModel:
        if self._known is None or self._known[0] != trial:
            timed = self._budget.max_seconds is not None
            self._known = trial, BakeModel(trial, self._seconds_of if timed else None)
        return self._known[1]

    def _seconds_of(self, work: Work) -> float:
        return wall_seconds(work, self._context, BAKE)

    @property
    def _tolerance(self) -> float:
        return self._parsed.settings.bounce_tolerance

    def _elapsed(self, results: Results, stage: str) -> float | None:
        """Tell the seconds of the job at a look at the clock; 0 where no time is asked for."""
        if self._budget.max_seconds is None:
            return 0.0
        looked = results.get(stage)
        return float(looked[0]["elapsed"]) if looked else None

    def _left(self, elapsed: float, model: BakeModel, told: Sequence[Told]) -> float | None:
        if self._budget.max_seconds is None:
            return None
        return self._budget.max_seconds - elapsed - self.rest_seconds(model, told)

    def rest_seconds(self, model: BakeModel | None, told: Sequence[Told]) -> float:
        """Say what is kept for the report, by what the last bake took over its prediction."""
        rest = wall_seconds({"report": REPORT_WORK}, self._context, ["report"])
        if model is None or not told:
            return kept_for(rest)
        last = told[-1]
        seen = model.foreseen(None, last.numbers.bounce_tolerance)
        predicted = float(seen.seconds[model.row(last.numbers)])
        return kept_for(rest, off_by(last.seconds or 0.0, predicted))

    def _refuse(self, name: str, why: str) -> NoReturn:
        raise SettingsError(why, pointer=f"/budget/{name}")

    def too_late(self, told: Sequence[Told]) -> str:
        """Say that the time was out before anything that keeps the budget was made."""
        words = f"{self._budget.max_seconds:g} s were out before a bake that keeps the budget"
        if not told:
            return f"{words}, or any, was made: this machine was slower than predicted"
        best = min(told, key=lambda one: one.error)
        left = percent(best.error) if isfinite(best.error) else "what nothing bounds"
        return f"{words} was made: the best leaves {left} in {best.size} bytes"

    def settings(self, model: BakeModel, numbers: Numbers) -> StageSettings:
        """Lay what was chosen over what the request gives."""
        fields = {name: value for name, value in self._given.items() if value is not None} | {
            "n_centres": numbers.n_centres,
            "cube_resolution": numbers.cube_resolution,
        }
        if numbers.term_energy_lost is not None:
            fields["term_energy_lost"] = numbers.term_energy_lost
        if numbers.n_terms is not None:
            fields["n_terms"] = numbers.n_terms
        if self._budget.max_error is not None:
            tolerance = numbers.bounce_tolerance
            fields |= {"bounce_tolerance": tolerance, "subsurface_tolerance": tolerance}
            fields.setdefault("bounce_rays", model.rays(tolerance))
            fields.setdefault("max_bounces", MOST_BOUNCES)
        return StageSettings.for_bake(BakeSettings.model_validate(fields))

    def first(self, store: BlobStore) -> First:
        """Try the scene here and now, and choose the first bake: for estimates.

        Raises
        ------
        SettingsError
            The job would be refused before it baked.
        """
        args = bake_trial.task(self._request, self._context, self._budget).args
        model = self._model(bake_trial.tried(args, store))
        left = self._left(0.0, model, [])
        choice = choose(model, self._budget, [], left=left, tolerance=self._tolerance)
        if choice.refused is not None:
            self._refuse(*choice.refused)
        if choice.numbers is None:
            raise ValueError("a search begins with a bake")
        seen, row = model.foreseen(None, choice.numbers.bounce_tolerance), model.row(choice.numbers)
        return First(
            settings=self.settings(model, choice.numbers),
            names=tuple(model.names),
            projection=tuple(seen.projection[row].tolist()),
            error=sqrt(float(seen.errors[row])),
            size=round(float(seen.sizes[row])),
        )

    # stages

    def stages(self) -> list[Stage]:
        """List the trial and the stages of all bakes that may be made."""

        def trial(_: Results) -> list[Task]:
            return [bake_trial.task(self._request, self._context, self._budget)]

        tried = limit(Stage("trial", "scene", 4.0, trial), self._until, self._context)
        listed = [tried, self._clock("clock", None)]
        models = {
            stage.name: stage
            for stage in bake.stages(
                self._request, self._context, StageSettings.for_bake(BakeSettings()), "medium"
            )
        }
        for attempt in range(MOST_BAKES):
            listed += [self._stage(models[name], attempt) for name in BAKE]
            listed.append(self._clock(numbered("clock", attempt), attempt))
        return listed

    def _stage(self, model: Stage, attempt: int) -> Stage:
        def tasks(results: Results) -> list[Task]:
            numbers = self._under_way(results, attempt)
            if numbers is None:
                return []
            if numbers not in self._made:
                settings = self.settings(self._model(results["trial"][0]), numbers)
                own = bake.stages(self._request, self._context, settings, "medium")
                self._made[numbers] = {stage.name: stage for stage in own}
            return self._made[numbers][model.name].tasks(attempt_view(results, attempt))

        stage = Stage(numbered(model.name, attempt), model.unit, model.weight, tasks)
        return limit(stage, self._until, self._context)

    def _until(self, results: Results) -> float | None:
        if self._budget.max_seconds is None:
            return None
        told = self.trail(results).told
        rest = self.rest_seconds(self._model(results["trial"][0]) if told else None, told)
        return float(self._context.get("started", 0.0)) + self._budget.max_seconds - rest

    def _clock(self, name: str, attempt: int | None) -> Stage:
        def look(results: Results) -> list[Task]:
            if self._budget.max_seconds is None:
                return []
            if attempt is not None and self._under_way(results, attempt) is None:
                return []
            return [clock.task(self._context.get("started", 0.0), name)]

        return Stage(name, "look", 0.1, look)

    def _under_way(self, results: Results, attempt: int) -> Numbers | None:
        trail = self.trail(results)
        if trail.over or len(trail.told) != attempt or len(trail.numbers) != attempt + 1:
            return None
        return trail.numbers[attempt]

    # what it has

    def aim(self, _: Results) -> float | None:
        """Give the error that is aimed at, at tuning views: a bake has none."""
        return None

    def tried(self, results: Results) -> list[Tried]:
        """List the bakes that were made."""
        trail = self.trail(results)
        found = []
        for attempt, one in enumerate(trail.told):
            taken = attempt == trail.delivered
            found.append(
                Tried(
                    _named(one.numbers),
                    finite(one.error),
                    taken=taken,
                    why=self._why(results, trail, attempt),
                    stages=tuple(numbered(name, attempt) for name in BAKE),
                )
            )
        if trail.late:
            attempt = len(trail.told)
            stages = tuple(numbered(name, attempt) for name in BAKE)
            why = "given up: its time was out"
            found.append(Tried(_named(trail.numbers[-1]), None, False, why, stages))
        return found

    def _why(self, results: Results, trail: Trail, attempt: int) -> str:
        told, budget = trail.told[attempt], self._budget
        own = account_of(lines_of(attempt_view(results, attempt)))
        words = f"most of it is {own['binds']} of {own['part']}"
        if budget.max_error is not None and told.error > budget.max_error:
            return f"leaves more than {percent(budget.max_error)}; {words}"
        if not meets(budget, told):
            return f"takes more than {budget.max_bytes} bytes; {words}"
        if attempt == trail.delivered:
            return (
                f"the {'best' if budget.max_error is None else 'cheapest'} that keeps it; {words}"
            )
        return f"another keeps it {'better' if budget.max_error is None else 'cheaper'}; {words}"

    def account(self, results: Results) -> dict[str, Any]:
        """Give the figure of what is delivered, and where it comes from, as JSON."""
        return account_of(lines_of(self.delivered(results)))

    def _names(self, results: Results) -> dict[str, str]:
        attempt = self.trail(results).delivered or 0
        return {name: numbered(name, attempt) for name in BAKE} | {"report": "report"}

    def is_delivered(self, name: str, results: Results) -> bool:
        """Tell whether a stage made something of what is delivered."""
        return name in self._names(results).values()

    def delivered(self, results: Results) -> Results:
        """Give the stages behind what is delivered, by the names that they have in other jobs."""
        return view(results, self._names(results))


def _named(numbers: Numbers) -> str:
    terms = numbers.term_energy_lost
    less = "" if terms is None else f", terms that lose at most {terms:.2g}"
    less += "" if numbers.n_terms is None else f", {numbers.n_terms} terms"
    return f"{numbers.n_centres} centres, 6 x {numbers.cube_resolution}^2 directions{less}"
