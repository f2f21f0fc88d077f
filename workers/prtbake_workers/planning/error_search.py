"""The search for settings whose pictures err by just less than what is asked for: its decisions.

Everything here is a pure function of what attempts measured at tuning views.  Three things are
settled one after the other, each at a price that the next one pays: the bake (a step of the
ladder), the light, the error of compression.  An asset is tuned to a share of the target, because
its views are not those that it will be seen from.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import exp, log, sqrt
from typing import Any, Literal

import numpy as np

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.planning.presets import PlannedBake
from prtbake_workers.planning.step_errors import Resolution, line_factors

NOISE_COUNTED = 0.5
"""Of the reference's variance: errors are held to be larger than they are, not smaller."""

SPREAD_COUNTED = 1.4
"""Spreads of single views that the target lies above the tuning views: two of a mean of two."""

SHARES = (0.75, 0.85)
"""Least and largest share of the target that is aimed at.

Held-out views of four assets, a sphere on a plane and Spot, erred by 0.84 to 0.97 of what tuning
views showed; the half of the noise that counts is only part of that.
"""

EASY = 0.85
"""Of the aim, that stored transfer may leave for there to be room for light and compression: half
of the aim then is theirs, and the step above may cost ten times as much."""

HARD = 0.97
"""The same where no step of the ladder leaves room: compression then is next to exact."""

LIGHT_EASY = 0.93
"""Of the aim, that transfer and light may leave together."""

TRUST = 1.25
"""By how much predictions of a step may be too high before it is not tried."""

WINDOW = (0.92, 1.04)
"""Shares of the aim between which an asset ends the search."""

MOST_COMPRESSIONS = 4
LARGEST_ERROR, LEAST_ERROR = 0.5, 1e-7
"""Of a compression, squared and relative to the transfer."""

FIRST_SHARE = 0.5
"""Of a compression's squared error, that pictures are taken to show before one has told."""

KINDS = {"K terms": "terms", "visibility sampling": "visibility"}
"""Of lines that the bake's settings decide, beside those of its basis."""

POWER_RANGE = (0.4, 2.5)
"""Between which the power of a picture's squared error by the transfer's is believed."""

LARGEST_STEP = 8.0
"""Of a compression's error, up or down."""


@dataclass(frozen=True)
class Pooled:
    """An error over several views, and how far single ones are from it, relative to it."""

    error: float
    spread: float
    noise: float


def pool(views: Sequence[Mapping[str, Any]], picture: str) -> Pooled:
    """Pool the squared differences of a picture over tuning views.

    The error counts part of the reference's noise in; the spread is weighted by the views' norms.
    It is zero, and the error infinite, where no view shows light.
    """
    norms = np.array([view["squared_norm"] for view in views])
    variances = np.array([view["variance"] for view in views])
    squared = np.array([view["squared"][picture] for view in views])
    lit = norms > variances
    if not lit.any():
        return Pooled(float("inf"), 0.0, float("inf"))
    norms, variances, squared = norms[lit], variances[lit], squared[lit]
    whole = float(norms.sum())
    counted = np.maximum(squared - variances + NOISE_COUNTED * variances, 0.0)
    single = np.sqrt(np.maximum(squared - variances, 0.0) / norms)
    middle = float((norms * single).sum() / whole)
    spread = sqrt(float((norms * (single - middle) ** 2).sum() / whole)) / middle if middle else 0.0
    return Pooled(
        sqrt(float(counted.sum()) / whole), float(spread), sqrt(float(variances.sum()) / whole)
    )


def pooled_lines(views: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Pool the lines of the chain."""
    whole = sum(view["squared_norm"] for view in views)
    names = views[0]["lines"] if views else {}
    return {
        name: sqrt(sum(v["squared_norm"] * v["lines"][name] ** 2 for v in views) / whole)
        if whole
        else 0.0
        for name in names
    }


def share_to_aim_at(spread: float) -> float:
    """Choose the share of a target at which views of its spread are held below it."""
    least, largest = SHARES
    return min(max(1.0 / (1.0 + SPREAD_COUNTED * spread), least), largest)


def squared_scale(line: str, own: BakeSettings, other: BakeSettings) -> float:
    """Predict a line's squared error at other settings of the bake, over that at its own.

    By the powers that studies were fitted with (`line_factors`); other lines stay as they are.
    """
    kind = "basis" if line.endswith("basis") else KINDS.get(line)
    return 1.0 if kind is None else line_factors(_numbers(own), _numbers(other))[kind] ** 2


def _numbers(bake: BakeSettings) -> Resolution:
    """Give what decides the lines of a bake; 0 for what its plan is to choose."""
    across = 0 if bake.cube_resolution == "auto" else bake.cube_resolution * bake.supersample
    chosen = None if bake.open_numbers else PlannedBake.model_validate(bake.model_dump())
    return Resolution(
        energy_lost=bake.term_energy_lost or 0.0,
        directions=6 * across**2,
        functions=0 if chosen is None else chosen.n_coeffs,
        light_functions=0,
        vectors=0,
    )


def predicted_errors(
    error: float, lines: Mapping[str, float], bakes: Sequence[BakeSettings]
) -> list[float]:
    """Predict what the stored transfer of every step errs by, from the first one's lines.

    The squares of the lines are scaled so that they add up to the first one's square: lines
    correlate, and are taken to do so alike.
    """
    own = {name: value**2 for name, value in lines.items() if name != "light fit"}
    whole = sum(own.values())
    if not whole:
        return [error] * len(bakes)
    return [
        error
        * sqrt(
            sum(value * squared_scale(name, bakes[0], bake) for name, value in own.items()) / whole
        )
        for bake in bakes
    ]


def binding_line(lines: Mapping[str, float], bakes: Sequence[BakeSettings]) -> str:
    """Name the line that is predicted to be the largest at the last step."""
    scaled = {
        name: value**2 * squared_scale(name, bakes[0], bakes[-1])
        for name, value in lines.items()
        if name != "light fit"
    }
    return max(scaled, key=lambda name: scaled[name], default="")


@dataclass(frozen=True)
class Choice:
    """What to do next: take what was tried last, try another step, or refuse the target."""

    what: Literal["take", "try", "refuse"]
    step: int
    best: float
    """What is left at best, as measured or predicted."""


def choose_bake(
    tried: Sequence[tuple[int, float]], predictions: Sequence[float], aim: float
) -> Choice:
    """Decide on the bake.

    Parameters
    ----------
    tried
        Steps and what their stored transfer errs by; steps rise.
    predictions
        Of every step.
    aim
        Share of the target that is aimed at, times the target.
    """
    step, error = tried[-1]
    scale = error / predictions[step] if predictions[step] else 1.0
    ahead = {other: scale * predictions[other] for other in range(step + 1, len(predictions))}
    best = min([error for _, error in tried] + list(ahead.values()))
    if error <= EASY * aim:
        return Choice("take", step, error)
    easy = [other for other, value in ahead.items() if value <= EASY * aim]
    if easy:
        return Choice("try", easy[0], best)
    if error <= HARD * aim:
        return Choice("take", step, error)
    hard = [other for other, value in ahead.items() if value <= HARD * aim]
    if hard:
        return Choice("try", hard[0], best)
    if ahead and best <= TRUST * aim:
        return Choice("try", len(predictions) - 1, best)
    return Choice("refuse", step, best)


def choose_light(
    tried: Sequence[tuple[int, float]], n_steps: int, transfer: float, aim: float
) -> Choice:
    """Decide on the light: ``tried`` are steps and what transfer and light err by together."""
    step, error = tried[-1]
    if error <= (LIGHT_EASY if transfer <= LIGHT_EASY * EASY * aim else HARD) * aim:
        return Choice("take", step, error)
    if step + 1 < n_steps:
        return Choice("try", step + 1, error)
    return Choice("take" if error <= HARD * aim else "refuse", step, error)


Compression = tuple[float, float | None]
"""What was asked of compression, squared, and what the asset errs by; None where it refused."""


def next_compression(tried: Sequence[Compression], base: float, aim: float) -> float | None:
    """Choose the error of the next compression; None ends the search.

    Parameters
    ----------
    tried
        In the order of their trial.
    base
        What transfer and light err by before compression.
    aim
        Of the whole.
    """
    gap = aim**2 - base**2
    if not tried:
        return _legal(max(gap, (1.0 - HARD**2) * aim**2) / FIRST_SHARE)
    if len(tried) >= MOST_COMPRESSIONS:
        return None
    least, most = (share * aim for share in WINDOW)
    asked, total = tried[-1]
    if total is not None and least <= total <= most:
        return None
    below = [e for e, value in tried if value is None or value <= most]
    above = [e for e, value in tried if value is not None and value > most]
    if total is not None and total < least and asked >= LARGEST_ERROR:
        return None
    low, high = max(below, default=None), min(above, default=None)
    wanted = 0.98 * aim
    if len(tried) == MOST_COMPRESSIONS - 1 and not _met(tried, most):
        wanted = 0.8 * aim if base < 0.7 * aim else 0.5 * (base + aim)
    found = _by_power(tried, base, wanted)
    if low is not None and found <= low:
        found = sqrt(low * high) if high is not None else 2.0 * low
    if high is not None and found >= high:
        found = sqrt(low * high) if low is not None else 0.5 * high
    found = _legal(found)
    return None if any(abs(found / e - 1.0) < 0.02 for e, _ in tried) else found


def _met(tried: Sequence[Compression], most: float) -> bool:
    return any(value is not None and value <= most for _, value in tried)


def _legal(error: float) -> float:
    return min(max(error, LEAST_ERROR), LARGEST_ERROR)


def _by_power(tried: Sequence[Compression], base: float, wanted: float) -> float:
    """Solve for an error: what compression adds to the square goes by a power of it."""
    told = [
        (log(e), log(max(value**2 - base**2, (0.05 * value) ** 2)))
        for e, value in tried
        if value is not None and value > 0.0
    ]
    asked = tried[-1][0]
    if not told:
        return 2.0 * asked
    power = 1.0
    x, y = told[-1]
    if len(told) > 1:
        # of two that are close to what is wanted, the slope tells more than the distance
        (x0, y0), (x1, y1) = told[-2:]
        if abs(x1 - x0) > 1e-3:
            power = min(max((y1 - y0) / (x1 - x0), POWER_RANGE[0]), POWER_RANGE[1])
    goal = log(max(wanted**2 - base**2, (0.05 * wanted) ** 2))
    step = min(max((goal - y) / power, -log(LARGEST_STEP)), log(LARGEST_STEP))
    return exp(x + step)


def best_compression(tried: Sequence[Compression], aim: float) -> int | None:
    """Choose the attempt of the largest error that is not above the aim; None where all are."""
    most = WINDOW[1] * aim
    met = [
        (value, -place)
        for place, (_, value) in enumerate(tried)
        if value is not None and value <= most
    ]
    return -max(met)[1] if met else None


def mended_compression(
    asked: float, tuned: float, base: float, held_out: float, target: float
) -> float | None:
    """Choose a compression for an asset whose held-out views err by more than the target.

    ``tuned`` and ``base`` are what the asset and the light before it err by at tuning views.  None
    where compression alone cannot make up for it.
    """
    own = base * held_out / tuned if tuned else 0.0
    goal = (0.9 * target) ** 2 - own**2
    added = held_out**2 - own**2
    if goal <= 0.0 or added <= 0.0:
        return None
    return _legal(asked * max(min(goal / added, 0.8), 0.02))
