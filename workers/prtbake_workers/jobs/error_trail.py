"""The decisions of a search for an error, told again from what its attempts measured.

A job may be taken up by another worker at any point: nothing is kept but results, and where the
search stands follows from them.
"""

from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Any

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import Quality
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.search_stages import BAKE, Tried, is_late, numbered
from prtbake_workers.planning.error_search import (
    MOST_COMPRESSIONS,
    WINDOW,
    Compression,
    Pooled,
    best_compression,
    binding_line,
    choose_bake,
    choose_light,
    mended_compression,
    next_compression,
    pool,
    pooled_lines,
    predicted_errors,
    share_to_aim_at,
)
from prtbake_workers.planning.ladder_steps import legal_steps
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.report.account import pooled_budget

REMEDIES = {
    "vertex interpolation": "a finer mesh or receiver",
    "light fit": "another method of fit_light",
}


@dataclass(frozen=True)
class Rung:
    """A step of the ladder, and its light among those that differ."""

    quality: Quality
    settings: StageSettings
    light: int


MENDED = MOST_COMPRESSIONS
"""Number of the compression that is made where held-out views err by too much."""


@dataclass
class Trail:
    """Where a search stands: what it tried, what is under way, what it has settled on."""

    rungs: list[int] = field(default_factory=list)
    """Of the attempts at the bake, the one under way too."""
    transfers: list[Pooled] = field(default_factory=list)
    lights: list[int] = field(default_factory=list)
    """Steps of the light that were fitted on the last bake, the one under way too."""
    lit: list[Pooled] = field(default_factory=list)
    asked: list[float] = field(default_factory=list)
    """Errors of the compressions, the one under way too."""
    compressed: list[Compression] = field(default_factory=list)
    aim: float = 0.0
    stage: str = "bake"
    """bake, light, compress, validate, mend or done: what is under way."""
    delivered: int | None = None
    """The compression that is delivered."""
    tried: list[Tried] = field(default_factory=list)
    """Every attempt, and why it was taken or left."""


class ErrorDecisions:
    """What a search of one request has decided at any point of it."""

    def __init__(self, request: AssetRequest) -> None:
        if request.budget is None or request.budget.max_error is None:
            raise ValueError("a search for an error needs one")
        self.budget, self.target = request.budget, request.budget.max_error
        self.rungs, self.lights = ladder_of(request)

    def trail(self, results: Results) -> Trail:
        """Go through the decisions again, from what was measured.

        Raises
        ------
        SettingsError
            The target cannot be met; it tells what can, and what stands in the way.
        """
        trail = Trail(rungs=[0])
        settled = (
            self._settle_bake(results, trail)
            and self._settle_light(results, trail)
            and self._settle_compression(results, trail)
        )
        if not settled and is_late(results):
            self._stop(trail)
            settled = True
        if settled:
            self._settle_validation(results, trail)
        return trail

    def _stop(self, trail: Trail) -> None:
        """Take the best of what there is when the time is out."""
        trail.delivered = best_compression(trail.compressed, trail.aim)
        if trail.delivered is None:
            seconds = self.budget.max_seconds or 0.0
            raise SettingsError(
                f"{seconds:g} s are too few for an error of {self.target:.2%}: no settings that "
                f"meet it were found when the search was given up in its step {trail.stage}",
                pointer="/budget/max_seconds",
            )
        self._enter_compressions(trail)

    def _settle_bake(self, results: Results, trail: Trail) -> bool:
        predictions: list[float] = []
        lines: dict[str, float] = {}
        bakes = [rung.settings.bake for rung in self.rungs]
        while True:
            attempt = len(trail.transfers)
            views = views_of(results, numbered("measure", attempt))
            if views is None:
                return False
            trail.transfers.append(pool(views, "transfer"))
            if not isfinite(trail.transfers[-1].error):
                raise SettingsError(
                    f"no error of {self.target:.2%} can be searched for: no tuning view shows "
                    "light that it would be relative to",
                    pointer="/budget/max_error",
                )
            if attempt == 0:
                trail.aim = self.target * share_to_aim_at(trail.transfers[0].spread)
                lines = pooled_lines(views)
                predictions = predicted_errors(trail.transfers[0].error, lines, bakes)
            tried = [
                (rung, own.error) for rung, own in zip(trail.rungs, trail.transfers, strict=True)
            ]
            choice = choose_bake(tried, predictions, trail.aim)
            if choice.what == "refuse":
                self.refuse(choice.best, binding_line(lines, bakes), trail)
            taken = choice.what == "take"
            trail.tried.append(
                Tried(
                    f"bake, {self.rungs[trail.rungs[-1]].quality}",
                    tried[-1][1],
                    taken=taken,
                    why="leaves room for light and compression"
                    if taken
                    else f"leaves no room below {trail.aim:.2%}",
                    stages=tuple(numbered(name, attempt) for name in (*BAKE, "measure")),
                )
            )
            if taken:
                step = self.rungs[trail.rungs[-1]].light
                trail.lights, trail.lit = [step], [pool(views, "light")]
                return True
            trail.rungs.append(choice.step)

    def _settle_light(self, results: Results, trail: Trail) -> bool:
        while True:
            tried = [(step, own.error) for step, own in zip(trail.lights, trail.lit, strict=True)]
            transfer = trail.transfers[-1].error
            choice = choose_light(tried, len(self.lights), transfer, trail.aim)
            if choice.what == "refuse":
                self.refuse(choice.best, "light fit", trail)
            taken = choice.what == "take"
            measured = (numbered("measure light", len(tried) - 2),) if len(tried) > 1 else ()
            trail.tried.append(
                Tried(
                    f"light, {self._light_name(trail.lights[-1])}",
                    tried[-1][1],
                    taken=taken,
                    why="leaves room for compression"
                    if taken
                    else f"leaves no room below {trail.aim:.2%}",
                    stages=(self.light_stage(trail), *measured),
                )
            )
            if taken:
                return True
            trail.lights.append(choice.step)
            trail.stage = "light"
            views = views_of(results, numbered("measure light", len(trail.lit) - 1))
            if views is None:
                return False
            trail.lit.append(pool(views, "light"))

    def _settle_compression(self, results: Results, trail: Trail) -> bool:
        trail.stage = "compress"
        base = trail.lit[-1].error
        while (asked := next_compression(trail.compressed, base, trail.aim)) is not None:
            trail.asked.append(asked)
            attempt = len(trail.compressed)
            refused = refusal(results, numbered("compress", attempt))
            views = views_of(results, numbered("measure asset", attempt))
            if refused is None and views is None:
                return False
            total = None if views is None else pool(views, "asset").error
            trail.compressed.append((asked, total))
        trail.delivered = best_compression(trail.compressed, trail.aim)
        if trail.delivered is None:
            self.refuse(base, "compression", trail)
        self._enter_compressions(trail)
        return True

    def _enter_compressions(self, trail: Trail) -> None:
        """Say of the compressions which is delivered, and why not the others."""
        for place, (asked, total) in enumerate(trail.compressed):
            taken = place == trail.delivered
            why = "errs by most of those that stay below the aim"
            if total is None:
                why = "cannot be met by this method of compression"
            elif not taken:
                above = total > WINDOW[1] * trail.aim
                why = f"errs by {'more' if above else 'less'} than the {trail.aim:.2%} aimed at"
            trail.tried.append(self._tried_compression(place, asked, total, taken=taken, why=why))

    def _tried_compression(
        self, place: int, asked: float, error: float | None, *, taken: bool, why: str
    ) -> Tried:
        names = ("compress", "quantise", *(() if place == MENDED else ("measure asset",)))
        return Tried(
            f"compression, max_error {asked:.3g}",
            error,
            taken=taken,
            why=why,
            stages=tuple(numbered(name, place) for name in names),
        )

    def _settle_validation(self, results: Results, trail: Trail) -> None:
        trail.stage = "validate"
        total = held_out(results, "validate 1")
        if total is None:
            return
        if total <= self.target:
            trail.stage = "done"
            return
        if trail.delivered is None:
            raise ValueError("nothing was compressed")
        asked, tuned = trail.compressed[trail.delivered]
        mended = mended_compression(asked, tuned or 0.0, trail.lit[-1].error, total, self.target)
        if mended is None:
            self.refuse(total, "held-out views", trail)
            return
        if is_late(results):
            raise SettingsError(
                f"{self.budget.max_seconds or 0.0:g} s are too few for an error of "
                f"{self.target:.2%}: held-out views err by {total:.2%}, and there was no time "
                "left to compress less",
                pointer="/budget/max_seconds",
            )
        place = next(at for at, one in reversed(list(enumerate(trail.tried))) if one.taken)
        trail.tried[place] = replace(
            trail.tried[place], taken=False, why=f"errs by {total:.2%} at held-out views"
        )
        trail.asked.append(mended)
        trail.stage = "mend"
        again = held_out(results, "validate 2")
        if again is None:
            return
        if again > self.target:
            self.refuse(again, "held-out views", trail)
        trail.compressed.append((mended, None))
        trail.delivered = MENDED
        why = "stays below the target at held-out views"
        trail.tried.append(self._tried_compression(MENDED, mended, again, taken=True, why=why))
        trail.stage = "done"

    def refuse(self, best: float, line: str, trail: Trail) -> None:
        """Refuse the target: say what is left at best, and which line of the budget most of it is.

        Raises
        ------
        SettingsError
            Always.
        """
        share = trail.aim / self.target
        remedy = REMEDIES.get(line)
        raise SettingsError(
            f"an error of {self.target:.2%} cannot be met: at best {best:.2%} is left at the "
            f"tuning views, where {trail.aim:.2%} is aimed at so that other views stay below; the "
            f"largest part of it is {line or 'light'}"
            f"{f', which {remedy} would lower' if remedy else ''}. "
            f"{1.05 * best / share:.2%} can be asked for",
            pointer="/budget/max_error",
        )

    def _light_name(self, step: int) -> str:
        settings = self.lights[step]
        return f"of {settings.n_lobes} lobes" if settings.n_lobes else settings.method

    def light_stage(self, trail: Trail) -> str:
        """Name the stage that fitted the last light."""
        tried = len(trail.lights)
        at = len(trail.rungs) - 1 if tried == 1 else len(self.rungs) + tried - 2
        return numbered("fit_light", at)


def done(values: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Give the results of tasks that might have refused, and did not."""
    return [value.get("attempted", value) for value in values]


def views_of(results: Results, stage: str) -> list[dict[str, Any]] | None:
    """Give what a stage measured, view by view; None where it has not, or was late."""
    if not (cameras := results.get(stage)) or any("late" in one for one in cameras):
        return None
    return [view for camera in cameras for view in camera["views"]]


def refusal(results: Results, stage: str) -> dict[str, Any] | None:
    """Say why a task of a stage refused, if one did."""
    return next((value["refused"] for value in results.get(stage, []) if "refused" in value), None)


def held_out(results: Results, stage: str) -> float | None:
    """Give the error of a finished validation, 0 where there is nothing to be relative to."""
    if not (cameras := results.get(stage)):
        return None
    budget = pooled_budget([view for camera in cameras for view in camera["views"]])
    total: float = budget["total"]
    return 0.0 if budget["black_reference"] else total


def ladder_of(request: AssetRequest) -> tuple[list[Rung], list[FitLightSettings]]:
    """Resolve the ladder with a request's overrides: bakes and lights that differ, lowest first.

    Raises
    ------
    SettingsError
        The overrides are legal at no step.
    """
    rungs: list[Rung] = []
    lights: list[FitLightSettings] = []
    for quality, settings in legal_steps(request.settings):
        if settings.fit_light not in lights:
            lights.append(settings.fit_light)
        if all(settings.bake != other.settings.bake for other in rungs):
            rungs.append(Rung(quality, settings, lights.index(settings.fit_light)))
    return rungs, lights
