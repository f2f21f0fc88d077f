"""Why a search for a bake ends with nothing: the field that binds, and the best that can be had."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor

import numpy as np

from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_workers.arrays import B8, Bool
from prtbake_workers.percent import percent
from prtbake_workers.planning.bake_model import BakeModel, Cut, Foreseen, Told
from prtbake_workers.planning.time_search import MARGIN

LATER_SIZE = 0.995
"""Of bytes that are asked for, that are aimed at: what a refusal names has to leave this room."""

LINES = {
    "projection": "what directions and functions leave",
    "terms": "what the BRDF's terms leave: more of them, or a smoother BRDF, would lower it",
    "rest": "what light between surfaces and inside them leaves, or effects that are left out",
}
"""What a line is that binds, and what would lower it."""

NOTHING_BOUNDS = (
    "nothing bounds what later bounces leave; more bounce_rays or a finer mesh would lower it"
)


@dataclass(frozen=True, eq=False)
class Left:
    """What a search has left that could still be made, where nothing that was made keeps a budget.

    Attributes
    ----------
    rows
        Those of the model that were not made, also where as many were as are made for a budget.
    fits
        Those that the bytes hold.
    nearly
        Relative L2 error that is tried for, infinite where none is asked for.
    seconds
        Until the last bake has to end; None where no time is asked for.
    """

    seen: Foreseen
    rows: Bool[B8, " rows"]
    fits: Bool[B8, " rows"]
    nearly: float
    seconds: float | None

    @property
    def within(self) -> Bool[B8, " rows"]:
        """Those of the rows that are predicted to keep the error."""
        return np.asarray(self.rows & (self.seen.errors <= self.nearly**2))

    @property
    def keeping(self) -> Bool[B8, " rows"]:
        """Those of the rows that are predicted to keep all that is asked for."""
        until = np.inf if self.seconds is None else self.seconds
        return np.asarray(self.within & self.fits & (MARGIN * self.seen.seconds <= until))

    @property
    def centres_help(self) -> bool:
        """Whether terms and the rest alone are predicted to leave room in the error."""
        others = (self.seen.terms + self.seen.rest).max(axis=1)
        return bool(others.min() <= self.nearly**2)


def refusal(
    model: BakeModel, budget: BakeBudget, told: Sequence[Told], left: Left
) -> tuple[str, str]:
    """Say which field cannot be kept, the best that can be, and what binds.

    The error binds where no bake that was made keeps it and none that is left is predicted to, or
    where one is and as many were made as are; what ended the trial binds where more centres might
    have kept the error; then the bytes, where they hold none of these; the time where they do.
    """
    met = [one for one in told if budget.max_error is None or one.error <= budget.max_error]
    if not met and left.keeping.any():
        return "max_error", _missed(model, budget, told)
    if not met and not left.within.any():
        cut = model.cut if left.centres_help else None
        field = "max_error" if cut is None else cut.field
        return field, _error_refused(model, budget, told, left, cut)
    within = left.within & left.fits
    if left.seconds is not None and within.any() and not left.keeping.any():
        needed = MARGIN * float(left.seen.seconds[within].min())
        return (
            "max_seconds",
            f"{budget.max_seconds:g} s are too few: {floor(max(left.seconds, 0.0))} s are left for "
            f"a bake, and the least that will do is predicted to take {ceil(needed)} s",
        )
    return "max_bytes", _bytes_refused(budget, told, met, left)


def _bytes_refused(
    budget: BakeBudget, told: Sequence[Told], met: Sequence[Told], left: Left
) -> str:
    asked = "" if budget.max_error is None else f" for an error of {percent(budget.max_error)}"
    # what nearly keeps the error is tried, but is nothing to promise where another does keep it
    keeps = left.rows & (left.seen.errors <= (budget.max_error or np.inf) ** 2)
    rows = keeps if keeps.any() else left.within
    # what fits is left only where as many were made as are, and names no more bytes to ask for
    predicted = float(np.where(rows & ~left.fits, left.seen.sizes, np.inf).min())
    measured = min((one.size for one in met), default=np.inf)
    least = ceil(min(measured, predicted) / LATER_SIZE)
    how = "was found to be" if measured <= predicted else "is predicted to be"
    made = f", by {_of_all(told)}" if told else ""
    return (
        f"max_bytes is {budget.max_bytes}: the least that can be asked for{asked} {how} "
        f"{least}{made}"
    )


def _of_all(told: Sequence[Told]) -> str:
    return "the one that was made" if len(told) == 1 else f"the {len(told)} that were made"


def _missed(model: BakeModel, budget: BakeBudget, told: Sequence[Told]) -> str:
    """Say that as many bakes were made as are, where others are predicted to keep the budget."""
    asked = f"an error of {percent(budget.max_error or 0.0)}"
    nearest = min(told, key=lambda one: one.error)
    why = f"{asked} is not met by the {len(told)} bakes that are made"
    if not np.isfinite(nearest.error):
        return f"{why}: {NOTHING_BOUNDS}"
    part, line = nearest.worst()
    return (
        f"{why}: at best {percent(nearest.error)} was left{_whose(model, part)}, and the largest "
        f"part of it is {LINES[line]}"
    )


def _error_refused(
    model: BakeModel, budget: BakeBudget, told: Sequence[Told], left: Left, cut: Cut | None
) -> str:
    """Say what is left at best of what was tried, and what more centres take if that binds."""
    errors = np.where(left.rows, left.seen.errors, np.inf)
    row = int(errors.argmin())
    (part, line), best = left.seen.worst(row), float(np.sqrt(errors[row]))
    how = "is predicted to be left"
    nearest = min(told, key=lambda one: one.error, default=None)
    if nearest is not None and nearest.error <= (1.0 + 1e-9) * best:
        (part, line), best = nearest.worst(), nearest.error
        how = f"was left, by the nearest of {len(told)}" if len(told) > 1 else "was left"
    inside, more = _cut_in_words(budget, cut)
    why = f"an error of {percent(budget.max_error or 0.0)} cannot be met{inside}"
    if not np.isfinite(best):
        return f"{why}: {NOTHING_BOUNDS}"
    words = LINES[line]
    if line == "projection":
        centres, fine = (max(choice[place] for choice in model.choices) for place in (0, 1))
        words += f": more than {centres} centres and 6 x {fine}^2 directions are not tried"
    return (
        f"{why}: at best {percent(best)} {how}{_whose(model, part)}, and the largest part of it "
        f"is {words}{more}"
    )


def _cut_in_words(budget: BakeBudget, cut: Cut | None) -> tuple[str, str]:
    """Say in what an error cannot be met, and what the next centres take of it."""
    if cut is None:
        return "", ""
    in_bytes = cut.field == "max_bytes"
    inside = f"{budget.max_bytes} bytes" if in_bytes else f"{budget.max_seconds:g} s"
    least = f"{cut.least} {'bytes' if in_bytes else 's'}"
    return f" in {inside}", f"; {cut.n_centres} centres are tried where there are {least} at least"


def _whose(model: BakeModel, part: int) -> str:
    return f" of {model.names[part]}" if len(model.names) > 1 else ""
