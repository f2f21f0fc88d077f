"""The decisions of a search for an error, told again from what its attempts measured.

A job may be taken up by another worker at any point: nothing is kept but results, and where the
search stands follows from them.
"""

from dataclasses import replace
from math import inf, isfinite
from typing import NoReturn

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.error_attempts import (
    BY_BYTES,
    FINER,
    MENDED,
    Asked,
    Trail,
    ladder_of,
    size_of,
)
from prtbake_workers.jobs.search_stages import (
    BAKE,
    Tried,
    held_out,
    is_late,
    numbered,
    refusal,
    refuse_as,
    views_of,
)
from prtbake_workers.percent import percent
from prtbake_workers.planning.byte_search import (
    Left,
    beyond_bytes,
    bytes_needed,
    finer_step,
    mended_by_bytes,
    of_finer,
    within,
)
from prtbake_workers.planning.error_search import (
    WINDOW,
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

REMEDIES = {
    "vertex interpolation": "a finer mesh or receiver",
    "light fit": "another method of fit_light",
}


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
        trail.delivered = self._best(trail)
        if trail.delivered is None:
            seconds = self.budget.max_seconds or 0.0
            raise SettingsError(
                f"{seconds:g} s are too few for {self._asked}: no settings that meet it were found "
                f"when the search was given up in its step {trail.stage}",
                pointer="/budget/max_seconds",
            )
        self._enter_compressions(trail)

    def _settle_bake(self, results: Results, trail: Trail) -> bool:
        bakes = [rung.settings.bake for rung in self.rungs]
        while True:
            attempt = len(trail.transfers)
            views = views_of(results, numbered("measure", attempt))
            if views is None:
                return False
            trail.transfers.append(pool(views, "transfer"))
            if not isfinite(trail.transfers[-1].error):
                raise SettingsError(
                    f"no error of {percent(self.target)} can be searched for: no tuning view shows "
                    "light that it would be relative to",
                    pointer="/budget/max_error",
                )
            if attempt == 0:
                trail.aim = self.target * share_to_aim_at(trail.transfers[0].spread)
                trail.lines = pooled_lines(views)
                trail.predictions = predicted_errors(trail.transfers[0].error, trail.lines, bakes)
            tried = [
                (rung, own.error) for rung, own in zip(trail.rungs, trail.transfers, strict=True)
            ]
            choice = choose_bake(tried, trail.predictions, trail.aim)
            if choice.what == "refuse":
                self.refuse(choice.best, binding_line(trail.lines, bakes), trail)
            taken = choice.what == "take"
            trail.tried.append(
                Tried(
                    f"bake, {self.rungs[trail.rungs[-1]].quality}",
                    tried[-1][1],
                    taken=taken,
                    why="leaves room for light and compression"
                    if taken
                    else f"leaves no room below {percent(trail.aim)}",
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
                    else f"leaves no room below {percent(trail.aim)}",
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
        base, most = trail.lit[-1].error, self.budget.max_bytes
        while True:
            asked = next_compression(trail.compressed, base, trail.aim)
            if asked is None:
                break
            attempt = len(trail.compressed)
            trail.asked[attempt] = {"max_error": asked}
            refused = refusal(results, numbered("compress", attempt))
            views = views_of(results, numbered("measure asset", attempt))
            if refused is None and views is None:
                return False
            total = None if views is None else pool(views, "asset").error
            trail.compressed.append((asked, total))
            trail.sizes.append(None if views is None else size_of(results, attempt))
            if beyond_bytes(total, trail.sizes[-1], trail.aim, most):
                break
        trail.delivered = self._best(trail)
        self._enter_compressions(trail)
        if trail.delivered is not None:
            return True
        if most is None or not any(size is not None and size > most for size in trail.sizes):
            self.refuse(base, "compression", trail)
        return self._settle_bytes(results, trail, most)

    def _settle_bytes(self, results: Results, trail: Trail, most: int) -> bool:
        """Make the least error of the bytes; where that is too large, of a finer bake's too."""
        left = self._all_bytes(results, trail, BY_BYTES, most)
        if left is None or _meets(left, trail):
            return left is not None
        shown = Left(trail.transfers[-1].error, trail.lit[-1].error, left)
        trail.finer = finer_step(trail.rungs[-1], trail.predictions, shown, trail.aim)
        if trail.finer is not None:
            trail.stage = "finer"
            left = self._all_bytes(results, trail, FINER, most)
            if left is None:
                return False
            if _meets(left, trail):
                self._enter_finer(trail)
                return True
        tried = [(shown, trail.rungs[-1])]
        if trail.finer is not None and isfinite(left):
            other = of_finer(trail.rungs[-1], trail.finer, trail.predictions, shown, left)
            tried.append((other, trail.finer))
        least, step = min(tried, key=lambda one: one[0].total)
        bakes = [rung.settings.bake for rung in self.rungs[: step + 1]]
        line = least.largest(binding_line(trail.lines, bakes))
        raise self._too_few(least.total, line, trail)

    def _all_bytes(self, results: Results, trail: Trail, place: int, most: int) -> float | None:
        """Give what a compression of all bytes errs by, None where it is not measured yet.

        It is infinite where mesh and tables of a finer bake do not fit.
        """
        trail.asked[place] = {"max_bytes": most}
        refused = refusal(results, numbered("quantise", place))
        if refused is not None:
            if place == BY_BYTES:
                refuse_as(refused)
            self._enter_bytes(trail, place, None, str(refused["detail"]))
            return inf
        views = views_of(results, numbered("measure asset", place))
        if views is None:
            return None
        total = pool(views, "asset").error
        met = _meets(total, trail)
        if met:
            trail.delivered = place
        above = f"errs by more than the {percent(trail.aim)} aimed at"
        self._enter_bytes(trail, place, total, "errs by least in its bytes" if met else above)
        return total

    def _best(self, trail: Trail) -> int | None:
        """Choose among the compressions for an error those that the bytes hold."""
        held = within(trail.compressed, trail.sizes, self.budget.max_bytes)
        return best_compression(held, trail.aim)

    def _enter_compressions(self, trail: Trail) -> None:
        """Say of the compressions for an error which is delivered, and why not the others."""
        most = self.budget.max_bytes
        for place, ((_, total), size) in enumerate(zip(trail.compressed, trail.sizes, strict=True)):
            taken = place == trail.delivered
            why = "errs by most of those that stay below the aim"
            if total is None:
                why = "cannot be met by this method of compression"
            elif not taken:
                above = total > WINDOW[1] * trail.aim
                why = (
                    f"errs by {'more' if above else 'less'} than the {percent(trail.aim)} aimed at"
                )
                if most is not None and size is not None and size > most:
                    why = f"takes more than {most} bytes"
            trail.tried.append(self._tried_compression(trail, place, total, taken=taken, why=why))

    def _enter_bytes(self, trail: Trail, place: int, total: float | None, why: str) -> None:
        taken = trail.delivered == place
        trail.tried.append(self._tried_compression(trail, place, total, taken=taken, why=why))

    def _enter_finer(self, trail: Trail) -> None:
        """Say of the finer bake, before its compression, that it stands in the first's place."""
        place = next(at for at, one in enumerate(trail.tried) if one.taken)
        why = "leaves too little room for compression in the bytes"
        trail.tried[place] = replace(trail.tried[place], taken=False, why=why)
        finer = Tried(
            f"bake, {self.rungs[trail.rung].quality}",
            None,
            taken=True,
            why="leaves more room for compression in the bytes",
            stages=tuple(numbered(name, len(self.rungs)) for name in BAKE),
        )
        trail.tried.insert(-1, finer)

    def _tried_compression(
        self, trail: Trail, place: int, error: float | None, *, taken: bool, why: str
    ) -> Tried:
        names = ("compress", "quantise", *(() if place == MENDED else ("measure asset",)))
        ((asked, value),) = trail.asked[place].items()
        return Tried(
            f"compression, {asked} {value if asked == 'max_bytes' else f'{value:.3g}'}",
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
        mended = self._mended(trail, trail.delivered, total)
        if mended is None:
            self._refuse_held_out(total, trail, trail.asked[trail.delivered])
        if is_late(results):
            raise SettingsError(
                f"{self.budget.max_seconds or 0.0:g} s are too few for an error of "
                f"{percent(self.target)}: held-out views err by {percent(total)}, and there was no "
                "time left to compress less",
                pointer="/budget/max_seconds",
            )
        place = next(at for at, one in reversed(list(enumerate(trail.tried))) if one.taken)
        trail.tried[place] = replace(
            trail.tried[place], taken=False, why=f"errs by {percent(total)} at held-out views"
        )
        trail.asked[MENDED] = mended
        trail.stage = "mend"
        most = self.budget.max_bytes
        made = (numbered("compress", MENDED), numbered("quantise", MENDED))
        if any(refusal(results, name) is not None for name in made):
            self._refuse_held_out(total, trail, mended)
        if most is not None and (size_of(results, MENDED) or 0) > most:
            self._refuse_held_out(total, trail, {"max_bytes": most})
        again = held_out(results, "validate 2")
        if again is None:
            return
        if again > self.target:
            self._refuse_held_out(again, trail, mended)
        trail.delivered = MENDED
        why = "stays below the target at held-out views"
        trail.tried.append(self._tried_compression(trail, MENDED, again, taken=True, why=why))
        trail.stage = "done"

    def _mended(self, trail: Trail, delivered: int, total: float) -> Asked | None:
        """Choose the compression that is made where held-out views err by too much."""
        if "max_bytes" in trail.asked[delivered]:
            return None  # no other errs by less in its bytes
        asked, tuned = trail.compressed[delivered]
        error = mended_compression(asked, tuned or 0.0, trail.lit[-1].error, total, self.target)
        if error is None:
            return None
        if mended_by_bytes(trail.sizes[delivered] or 0, self.budget.max_bytes):
            return {"max_bytes": self.budget.max_bytes}
        return {"max_error": error}

    def _refuse_held_out(self, error: float, trail: Trail, asked: Asked) -> NoReturn:
        """Refuse what held-out views err by: the bytes, where these were what was left to try."""
        if "max_bytes" not in asked:
            self.refuse(error, "held-out views", trail)
        raise SettingsError(
            f"{self._asked} cannot be met: held-out views err by {percent(error)}, where tuning "
            f"views met it. {percent(1.05 * error)} can be asked for, or more bytes",
            pointer="/budget/max_bytes",
        )

    def refuse(self, best: float, line: str, trail: Trail) -> NoReturn:
        """Refuse the target: say what is left at best, and which line of the budget most of it is.

        Raises
        ------
        SettingsError
            Always.
        """
        share = trail.aim / self.target
        remedy = REMEDIES.get(line)
        # a finer step was not tried where it is predicted to be of no use
        measured = best >= min(one.error for one in trail.transfers)
        verb, sure = ("is left", "can be") if measured else ("is predicted to be left", "may be")
        raise SettingsError(
            f"an error of {percent(self.target)} cannot be met: at best {percent(best)} {verb} at "
            f"the tuning views, where {percent(trail.aim)} is aimed at so that other views stay "
            f"below; the largest part of it is {line or 'light'}"
            f"{f', which {remedy} would lower' if remedy else ''}. "
            f"{percent(1.05 * best / share)} {sure} asked for",
            pointer="/budget/max_error",
        )

    def _too_few(self, best: float, line: str, trail: Trail) -> SettingsError:
        """Say of the bytes what is left in them at best, and which line most of it is."""
        share = trail.aim / self.target
        needed = bytes_needed(trail.compressed, trail.sizes, trail.aim)
        return SettingsError(
            f"{self._asked} cannot be met: at best {percent(best)} is left at the tuning views, "
            f"where {percent(trail.aim)} is aimed at so that other views stay below; the largest "
            f"part of it is {line or 'light'}. "
            f"{percent(1.05 * best / share)} can be asked for, or {needed}",
            pointer="/budget/max_bytes",
        )

    @property
    def _asked(self) -> str:
        most = self.budget.max_bytes
        return f"an error of {percent(self.target)}{'' if most is None else f' in {most} bytes'}"

    def _light_name(self, step: int) -> str:
        settings = self.lights[step]
        return f"of {settings.n_lobes} lobes" if settings.n_lobes else settings.method

    def light_stage(self, trail: Trail) -> str:
        """Name the stage that fitted the last light."""
        tried = len(trail.lights)
        at = len(trail.rungs) - 1 if tried == 1 else len(self.rungs) + tried - 2
        return numbered("fit_light", at)


def _meets(total: float, trail: Trail) -> bool:
    return total <= WINDOW[1] * trail.aim
