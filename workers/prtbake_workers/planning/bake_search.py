"""The search for a bake that keeps a budget: its decisions, as pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_workers.arrays import B8, F64, Bool, Float64
from prtbake_workers.planning.bake_model import BakeModel, Foreseen, Numbers, Told
from prtbake_workers.planning.time_search import MARGIN

MOST_BAKES = 4
"""Made for one budget."""

WINDOW = 0.9
"""Of an error that is asked for: a bake between this share of it and all of it will do."""

AIM = 0.95
"""Of that error, aimed at."""

BOUNCE_SHARE, MOST_REST = 0.1, 0.3
"""Of the squared error: what bounces may leave to their rays and to what comes after them each, and
the most that all but terms and projection may take before their tolerance is lowered."""

NEARLY = 1.1
"""Times the error: the best there is, tried before it is refused while nothing was measured."""

FIRST_SIZE, LATER_SIZE = 0.97, 0.995
"""Of bytes that are asked for, aimed at before a file was written and after."""

FIRST_TIME = 0.2
"""Of the time that is left, for the first bake: it tells what the others will take."""

BETTER = 0.97
"""Times the error of the best so far, that another bake is worth it."""

AS_GOOD = 1.05
"""Times the least squared error: bakes within it are as good, and the cheapest of them is taken."""

LEAST_TOLERANCE = 1e-9

UNBOUNDED = 8.0
"""By which the tolerance is divided where bounces grow: they do so by the noise of few rays."""


@dataclass(frozen=True)
class Choice:
    """The next bake; none where the search is over.  ``refused`` names a field and says why."""

    numbers: Numbers | None
    refused: tuple[str, str] | None = None


def meets(budget: BakeBudget, told: Told) -> bool:
    """Tell whether a bake keeps what is asked of error and bytes."""
    above = budget.max_error is not None and not told.error <= budget.max_error
    return not above and (budget.max_bytes is None or told.size <= budget.max_bytes)


def delivered(model: BakeModel, budget: BakeBudget, told: Sequence[Told]) -> int | None:
    """Choose among bakes that were made: the cheapest, or without an error the best."""
    met = [place for place, one in enumerate(told) if meets(budget, one)]
    if budget.max_error is None:
        return min(met, key=lambda place: told[place].error, default=None)
    return min(met, key=lambda place: model.cost[model.row(told[place].numbers)], default=None)


def bounce_tolerance(budget: BakeBudget, told: Told | None, given: float) -> float:
    """Choose what bounces are traced to: by the error, and where it took too much of it, less."""
    if budget.max_error is None:
        return given
    squared = budget.max_error**2
    if told is None:
        return BOUNCE_SHARE * squared
    before, rest = told.numbers.bounce_tolerance, max(told.rest)
    if rest <= MOST_REST * squared:
        return before
    if rest == np.inf:
        return max(LEAST_TOLERANCE, before / UNBOUNDED)
    return max(LEAST_TOLERANCE, before * 0.5 * MOST_REST * squared / rest)


def choose(
    model: BakeModel,
    budget: BakeBudget,
    told: Sequence[Told],
    *,
    left: float | None,
    tolerance: float,
) -> Choice:
    """Choose the next bake from what the ones before told.

    Parameters
    ----------
    told
        Bakes that were made, in order.
    left
        Seconds until the last of them has to end; None where no time is asked for.
    tolerance
        Of bounces, where no error decides it.

    Returns
    -------
    Choice
        With a refusal only where nothing that was made keeps the budget and nothing more can.
    """
    best = delivered(model, budget, told)
    last = told[-1] if told else None
    asked = budget.max_error
    near = asked is not None and last is not None and last.error >= WINDOW * asked
    if near and best == len(told) - 1:
        return Choice(None)
    if len(told) == MOST_BAKES:
        return Choice(None, None if best is not None else _refusal(model, budget, told, None))
    aimed = bounce_tolerance(budget, last, tolerance)
    seen = model.foreseen(last, aimed)
    for share in (LATER_SIZE,) if told else (FIRST_SIZE, LATER_SIZE):
        fits = _untried(model, told, aimed) & _in_size(budget, seen, share)
        row = (
            _best(model, seen, fits, told, best, left)
            if asked is None
            else _cheapest(model, asked, seen, fits & _in_time(seen, left), told, best)
        )
        if row is not None:
            return Choice(model.numbers(row, aimed))
    return Choice(None, None if best is not None else _refusal(model, budget, told, left, seen))


def _untried(model: BakeModel, told: Sequence[Told], tolerance: float) -> Bool[B8, " rows"]:
    found = np.ones(len(model.choices), np.bool_)
    found[[model.row(one.numbers) for one in told if one.numbers.bounce_tolerance == tolerance]] = (
        False
    )
    return found


def _in_size(budget: BakeBudget, seen: Foreseen, share: float = LATER_SIZE) -> Bool[B8, " rows"]:
    if budget.max_bytes is None:
        return np.ones(len(seen.sizes), np.bool_)
    return np.asarray(seen.sizes <= share * budget.max_bytes)


def _in_time(seen: Foreseen, left: float | None) -> Bool[B8, " rows"]:
    if left is None:
        return np.ones(len(seen.seconds), np.bool_)
    return np.asarray(MARGIN * seen.seconds <= left)


def _cheapest(
    model: BakeModel,
    max_error: float,
    seen: Foreseen,
    fits: Bool[B8, " rows"],
    told: Sequence[Told],
    best: int | None,
) -> int | None:
    """Take the cheapest that is predicted to err by the aim, or what comes nearest to the error."""
    errors = seen.errors
    good = fits & (errors <= (AIM * max_error) ** 2)
    if best is not None:
        good &= model.cost < model.cost[model.row(told[best].numbers)]
        return _least(model.cost, good)
    if good.any():
        return _least(model.cost, good)
    nearly = max_error * (1.0 if told else NEARLY)
    return _least(errors, fits & (errors <= nearly**2))


def _best(
    model: BakeModel,
    seen: Foreseen,
    fits: Bool[B8, " rows"],
    told: Sequence[Told],
    best: int | None,
    left: float | None,
) -> int | None:
    """Take what errs by least, and of what is about as good the cheapest."""
    errors, in_time = seen.errors, _in_time(seen, left)
    if left is not None and not told:
        early = in_time & (seen.seconds <= FIRST_TIME * left)
        # where none is quick, the quickest
        if not (fits & early).any():
            return _least(seen.seconds, fits & in_time)
        in_time = early
    pool = fits & in_time
    if best is not None:
        pool &= errors < (BETTER * told[best].error) ** 2
    if not pool.any():
        return None
    return _least(model.cost, pool & (errors <= AS_GOOD * errors[pool].min()))


def _least(values: Float64[F64, " rows"], among: Bool[B8, " rows"]) -> int | None:
    return int(np.where(among, values, np.inf).argmin()) if among.any() else None


LINES = {
    "projection": "what directions and functions leave: more than {centres} centres and 6 x "
    "{fine}^2 directions are not tried{why}",
    "terms": "what the BRDF's terms leave: more of them, or a smoother BRDF, would lower it",
    "rest": "what light between surfaces and inside them leaves, or effects that are left out",
}
"""What a line is that binds, and what would lower it."""


def _refusal(
    model: BakeModel,
    budget: BakeBudget,
    told: Sequence[Told],
    left: float | None,
    seen: Foreseen | None = None,
) -> tuple[str, str]:
    """Say which field cannot be kept, the best that can be, and what binds."""
    last = told[-1] if told else None
    if seen is None:
        tolerance = last.numbers.bounce_tolerance if last is not None else 0.0
        seen = model.foreseen(last, tolerance)
    errors = seen.errors
    within = np.ones(len(errors), np.bool_)
    if budget.max_error is not None:
        within = errors <= budget.max_error**2
        if not within.any() or (len(told) == MOST_BAKES and budget.max_bytes is None):
            return "max_error", _error_refused(model, budget, told, seen)
    if budget.max_bytes is not None and not (within & _in_size(budget, seen)).any():
        least = int(np.where(within, seen.sizes, np.inf).min())
        asked = "" if budget.max_error is None else f" for an error of {budget.max_error:.2%}"
        made = "" if last is None else ", by the one that was made"
        return (
            "max_bytes",
            f"max_bytes is {budget.max_bytes}: the least that is possible{asked} is predicted to "
            f"take {least}{made}",
        )
    if left is not None:
        seconds = np.where(within & _in_size(budget, seen), seen.seconds, np.inf)
        needed = MARGIN * float(seconds.min())
        return (
            "max_seconds",
            f"{budget.max_seconds:g} s are too few: {max(left, 0.0):.0f} s are left for a bake, "
            f"and the least that will do is predicted to take {needed:.0f} s",
        )
    sizes = ", ".join(str(one.size) for one in told)
    return "max_bytes", f"max_bytes is {budget.max_bytes}: the bakes that were made take {sizes}"


def _error_refused(
    model: BakeModel, budget: BakeBudget, told: Sequence[Told], seen: Foreseen
) -> str:
    max_error, seconds = budget.max_error or 0.0, budget.max_seconds
    row = int(seen.errors.argmin())
    (part, line), best = seen.worst(row), float(np.sqrt(seen.errors[row]))
    how = "is predicted to be left"
    nearest = min(told, key=lambda one: one.error, default=None)
    if nearest is not None and (nearest.error <= (1.0 + 1e-9) * best or best <= max_error):
        (part, line), best = nearest.worst(), nearest.error
        how = f"was left, by the nearest of {len(told)}" if len(told) > 1 else "was left"
    if not np.isfinite(best):
        return (
            f"an error of {max_error:.2%} cannot be met: nothing bounds what later bounces leave; "
            "more bounce_rays or a finer mesh would lower it"
        )
    centres, fine = (max(choice[place] for choice in model.choices) for place in (0, 1))
    why = "" if seconds is None else f" in {seconds:g} s"
    words = LINES[line].format(centres=centres, fine=fine, why=why)
    whose = f" of {model.names[part]}" if len(model.names) > 1 else ""
    return (
        f"an error of {max_error:.2%} cannot be met: at best {best:.2%} {how}{whose}, and the "
        f"largest part of it is {words}"
    )
