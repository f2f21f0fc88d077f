"""An ``asset`` job that is given ``max_seconds`` alone: the best of the ladder that they allow.

The lowest step comes first, if its prediction fits at all.  What it took says how far predictions
are off here and now; the highest step that then fits is made after it, and so on.  Tasks of an
attempt that runs late leave, and the best so far is delivered.  Where bytes are asked for too,
every attempt keeps to them.
"""

from dataclasses import dataclass, field, replace
from typing import Any

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.contract.settings import ValidateSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs import bake, clock, compress, fit_light, render, validate
from prtbake_workers.jobs.lights import light_source
from prtbake_workers.jobs.search_stages import (
    AFTER,
    MADE,
    Tried,
    attempt_view,
    check_least,
    done,
    held_predictions,
    is_late,
    limit,
    numbered,
    refusal,
    refuse_as,
    seconds_of,
    unshared,
    view,
)
from prtbake_workers.jobs.shared_stages import attempted
from prtbake_workers.jobs.work import asset_work, fit_samples, n_texels, wall_seconds
from prtbake_workers.planning.ladder_steps import legal_steps, making_seconds
from prtbake_workers.planning.later_stages import later_work
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.rates import Rates
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.planning.time_search import (
    Measured,
    Step,
    choose_step,
    kept_for,
    predicted_seconds,
    samples_for,
)


@dataclass
class Trail:
    """Where a search stands: the steps it made, the one under way last unless it is over."""

    steps: list[int] = field(default_factory=list)
    over: bool = False
    elapsed: float = 0.0
    told: Measured | None = None
    """By the last attempt that was made."""
    tried: list[Tried] = field(default_factory=list)

    @property
    def delivered(self) -> int:
        """The last attempt that was made."""
        return len(self.steps) - 1


class TimeSearch:
    """The search of one job."""

    def __init__(self, request: dict[str, Any], context: dict[str, Any]) -> None:
        self._context = context
        self._parsed = AssetRequest.model_validate(request)
        if self._parsed.budget is None or self._parsed.budget.max_seconds is None:
            raise ValueError("a search for a time needs one")
        self._seconds, self._most = self._parsed.budget.max_seconds, self._parsed.budget.max_bytes
        self._ladder = legal_steps(self._parsed.settings)
        self._bakes = [
            {stage.name: stage for stage in bake.stages(request, context, settings, quality)}
            for quality, settings in self._ladder
        ]
        self._environment = light_source(context)

    # decisions

    def trail(self, results: Results) -> Trail:
        """Go through the decisions again, from what was measured.

        Raises
        ------
        SettingsError
            The time is too short for the lowest step, or the bytes are too few; it tells what that
            is predicted to take, or takes.
        """
        trail = Trail(steps=[0])
        self._check_first(results)
        while True:
            attempt = len(trail.steps) - 1
            own = attempt_view(results, attempt, MADE)
            if is_late(own):
                return self._stopped(trail)
            if (refused := refusal(own, "quantise")) is not None:
                if attempt == 0:
                    refuse_as(refused)
                return self._given_up(trail, refused["detail"], "the best that fits into the bytes")
            looked = results.get(numbered("clock", attempt))
            if not looked:
                return trail
            before, trail.elapsed = trail.elapsed, looked[0]["elapsed"]
            step = trail.steps[-1]
            fit = seconds_of(own, ["fit_light"])
            predicted = self._step(results, step)
            trail.told = Measured(
                predicted.making, trail.elapsed - before - fit, predicted.fit, fit
            )
            steps = {other: self._step(results, other) for other in self._predicted(results)}
            left = self._seconds - trail.elapsed
            chosen, least = choose_step(steps, step, trail.told, left)
            if chosen is None:
                why = self._nothing_above(step) if least is None else self._too_long(least, left)
                self._enter(trail, taken=True, why=why)
                trail.over = True
                return trail
            self._enter(trail, taken=False, why="there was time for a better one")
            trail.steps.append(chosen)

    def _nothing_above(self, step: int) -> str:
        above = [settings.bake.open_numbers for _, settings in self._ladder[step + 1 :]]
        if not (names := sorted({name for own in above for name in own})):
            return "nothing is above it"
        return (
            f"what is above it leaves {' and '.join(names)} of the bake to a trial, and its time "
            "cannot be foretold: numbers in their place let the search climb"
        )

    def _too_long(self, least: float, left: float) -> str:
        return f"a better one would take {least:.0f} s of the {left:.0f} s that were left"

    def _enter(self, trail: Trail, *, taken: bool, why: str) -> None:
        attempt = len(trail.steps) - 1
        quality = self._ladder[trail.steps[-1]][0]
        stages = tuple(numbered(name, attempt) for name in MADE)
        trail.tried.append(Tried(f"quality {quality}", None, taken=taken, why=why, stages=stages))

    def _stopped(self, trail: Trail) -> Trail:
        """Take the attempt before the one that ran late."""
        if len(trail.steps) == 1:
            raise SettingsError(
                f"{self._seconds:g} s were out before an asset of quality {self._ladder[0][0]}, "
                "the least there is, was made: this machine was slower than predicted",
                pointer="/budget/max_seconds",
            )
        why = "given up: its time was out"
        return self._given_up(trail, why, "the best that was made in time")

    def _given_up(self, trail: Trail, why: str, why_before: str) -> Trail:
        """Leave the last attempt for the one before."""
        self._enter(trail, taken=False, why=why)
        trail.steps.pop()
        trail.over = True
        trail.tried[-2] = replace(trail.tried[-2], taken=True, why=why_before)
        return trail

    def _check_first(self, results: Results) -> None:
        if not (planned := results.get("plan 1")):
            return
        settings = self._settings(results, 0)
        work = asset_work(planned[0]["plan"], settings, self._context)
        check_least(self._seconds, work, self._context, self._ladder[0][0])

    def _settings(self, results: Results, step: int) -> StageSettings:
        """Give a step's settings, numbers left open as the first plan settled them."""
        settings = self._ladder[step][1]
        if not settings.bake.open_numbers:
            return settings
        return StageSettings.from_dict(results["plan 1"][0]["settings"])

    def _predicted(self, results: Results) -> list[int]:
        """List the steps that the first plan predicts."""
        known = {step["quality"] for step in results["plan 1"][0]["plan"]["ladder"]}
        return [at for at, (quality, _) in enumerate(self._ladder) if quality in known]

    def _step(self, results: Results, step: int) -> Step:
        """Predict a step by the rates that are shipped: measured attempts say how far they are off.

        The validation sees the same pixels at every step.
        """
        plan = results["plan 1"][0]["plan"]
        quality = self._ladder[step][0]
        settings = self._settings(results, step)
        ladder = {one["quality"]: one for one in plan["ladder"]}
        terms = [part["n_terms"] for part in plan["parts"]]
        making = making_seconds(Rates().all_seconds(plan["work"]))
        if step:
            making, terms = ladder[quality]["seconds"], ladder[quality]["terms"]
        samples = fit_samples(settings.fit_light, self._context)
        later = later_work(
            settings,
            n_verts=[part["vertex_range"][1] - part["vertex_range"][0] for part in plan["parts"]],
            part_terms=terms,
            seen=[SeenPixels(**one) for one in plan["seen"]],
            n_texels=n_texels(self._context),
            samples=samples,
            baked_bounces=plan["bounces"] is not None and plan["bounces"]["max_bounces"] > 0,
        )
        return Step(
            making=making,
            fit=Rates().stage_seconds("fit_light", later["fit_light"]),
            rest=wall_seconds(later, self._context | {"rates": None}, AFTER),
        )

    def _rest(self, results: Results, trail: Trail) -> float:
        """Predict what comes after the search, at the largest of the steps it may end with."""
        rests = []
        for step in trail.steps[-2:]:
            own = self._step(results, step)
            rests.append(
                kept_for(own.rest) if trail.told is None else predicted_seconds(own, trail.told)[1]
            )
        return max(rests)

    # stages

    def stages(self) -> list[Stage]:
        """List the stages of all attempts, then validation and previews."""
        listed: list[Stage] = []
        for attempt in range(len(self._ladder)):
            listed += self._attempt_stages(attempt)
        settings = self._ladder[0][1]

        def lit(results: Results) -> dict[str, Any]:
            own = self.delivered(results)
            return {
                "asset": own["quantise"][0]["asset"],
                "light": own["fit_light"][0]["light"],
            }

        return [
            *listed,
            *render.stages(lit, settings.render),
            Stage("validate", "cameras", 15.0, self._validation),
        ]

    def _attempt_stages(self, attempt: int) -> list[Stage]:
        def under_way(results: Results) -> int | None:
            trail = self.trail(results)
            return trail.steps[-1] if not trail.over and trail.delivered == attempt else None

        def made(name: str, model: Stage) -> Stage:
            def tasks(results: Results) -> list[Task]:
                step = under_way(results)
                if step is None:
                    return []
                own = attempt_view(results, attempt, MADE)
                return self._tasks(name, step, own, first=attempt == 0)

            stage = Stage(numbered(name, attempt), model.unit, model.weight, tasks)
            # the first plan says whether there is time at all
            first = attempt == 0 and name == "plan"
            return stage if first else limit(stage, self._until, self._context)

        def look(results: Results) -> list[Task]:
            if under_way(results) is None:
                return []
            return [clock.task(self._context.get("started", 0.0), f"attempt {attempt + 1}")]

        models = self._models(0)
        return [
            *(made(name, models[name]) for name in MADE),
            Stage(numbered("clock", attempt), "look", 0.1, look),
        ]

    def _models(self, step: int) -> dict[str, Stage]:
        """Give the stages of a step, as they are of any asset."""

        def planned(results: Results) -> tuple[str, list[dict[str, Any]]]:
            return results["join"][0]["transfer"], unshared(results["plan"][0]["plan"])

        settings, seed = self._ladder[step][1], self._parsed.seed
        started = self._context.get("started")
        later = [
            *compress.stages(planned, settings.compress, seed, started=started, held_to=self._most),
            *fit_light.stages(self._environment, settings.fit_light, seed, started=started),
        ]
        return self._bakes[step] | {stage.name: stage for stage in later}

    def _tasks(self, name: str, step: int, own: Results, *, first: bool) -> list[Task]:
        tasks = self._models(step)[name].tasks(own)
        if name == "quantise" and self._most is not None:
            # mesh and tables of a step may take more than all bytes
            return [attempted(task) for task in tasks]
        if name != "plan" or not first:
            return tasks
        # the first plan predicts all the others
        steps = {quality: settings.to_dict() for quality, settings in self._ladder[1:]}
        return [replace(task, args=task.args | {"steps": steps}) for task in tasks]

    def _until(self, results: Results) -> float:
        trail = self.trail(results)
        end = float(self._context.get("started", 0.0)) + self._seconds
        return end - self._rest(results, trail)

    def _validation(self, results: Results) -> list[Task]:
        own = self.delivered(results)
        inputs = {
            "asset": own["quantise"][0]["asset"],
            "exact": own["quantise"][0]["exact"],
            "light": own["fit_light"][0]["light"],
            "transfer": own["join"][0]["transfer"],
        }
        settings = self.validate_settings(results)
        (stage,) = validate.stages(lambda _: inputs, self._environment, settings, self._parsed.seed)
        return stage.tasks(results)

    def validate_settings(self, results: Results) -> ValidateSettings:
        """Give the validation no more samples than there is time for."""
        trail = self.trail(results)
        settings = self._ladder[trail.steps[-1]][1].validation
        rest, left = self._rest(results, trail), self._seconds - trail.elapsed
        return settings.model_copy(update={"samples": samples_for(settings.samples, rest, left)})

    # what it has

    def aim(self, _: Results) -> float | None:
        """Give the error that is aimed at: none is."""
        return None

    def tried(self, results: Results) -> list[Tried]:
        """List the attempts."""
        return self.trail(results).tried

    def _names(self, results: Results) -> dict[str, str]:
        attempt = self.trail(results).delivered
        names = {name: numbered(name, attempt) for name in MADE}
        return names | {name: name for name in AFTER}

    def is_delivered(self, name: str, results: Results) -> bool:
        """Tell whether a stage made something of what is delivered."""
        return name in self._names(results).values()

    def delivered(self, results: Results) -> Results:
        """Give the stages behind what is delivered, by the names that they have in other jobs."""
        seen, found = view(results, self._names(results)), Results()
        for name in seen:
            values = done(seen[name])
            if name == "plan":
                values = [held_predictions(values[0], self._most)]
            found.add(name, values, seen.measured(name), recalled=seen.recalled(name))
        return found
