"""The search for a bake that keeps a budget: its decisions, as pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_workers.arrays import B8, F64, Bool, Float64
from prtbake_workers.planning.bake_model import BakeModel, Foreseen, Numbers, Told
from prtbake_workers.planning.bake_refusal import LATER_SIZE, Left, refusal
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
"""Times what is asked for of error and bytes: the best there is, tried before it is refused while
nothing was measured."""

FIRST_SIZE = 0.97
"""Of bytes that are asked for, aimed at before a file was written; `LATER_SIZE` after."""

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
    if asked is None and best is not None and told[best].error == np.inf:
        # bounces grow by the noise of rays, of which no other choice takes more
        return Choice(None)
    aimed = bounce_tolerance(budget, last, tolerance)
    seen, unmade = model.foreseen(last, aimed), _unmade(model, told, aimed)
    rows = unmade if len(told) < MOST_BAKES else np.zeros_like(unmade)
    for share in (LATER_SIZE,) if told else (FIRST_SIZE, LATER_SIZE):
        fits = rows & _in_size(budget, seen, share)
        row = (
            _best(model, seen, fits, told, best, left)
            if asked is None
            else _cheapest(model, asked, seen, fits & _in_time(seen, left), told, best)
        )
        if row is not None:
            return Choice(model.numbers(row, aimed))
    if best is not None:
        return Choice(None)
    rest = Left(
        seen,
        unmade,
        _in_size(budget, seen, LATER_SIZE if told else NEARLY),
        np.inf if asked is None else _nearly(asked, told),
        left,
    )
    # while nothing was measured, what is predicted to take a little more may fit
    row = _least(seen.sizes, rows & rest.keeping)
    if row is not None:
        return Choice(model.numbers(row, aimed))
    return Choice(None, refusal(model, budget, told, rest))


def _unmade(model: BakeModel, told: Sequence[Told], tolerance: float) -> Bool[B8, " rows"]:
    """Tell which rows were not made by such a tolerance of bounces."""
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
    return _least(errors, fits & (errors <= _nearly(max_error, told) ** 2))


def _nearly(max_error: float, told: Sequence[Told]) -> float:
    """Give the predicted error that is tried: more than is asked for while none is measured."""
    return max_error if told else NEARLY * max_error


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
