"""The fewest bits with which the factors of a part meet a bound on the error of rounding them.

Where numbers are coded by their entropy, halving the step of one costs one bit whatever its size,
and lowers the squared error by 3/4 of g s^2 / 12, with g what the number weighs in it
(`prtbake_workers.compress.rounding_error`).  At the fewest bits for an error no exchange of bits
between two numbers gains anything, so g s^2 is the same for all of them: one number t gives every
step, s = t / sqrt(g), and a column that lies below its step is dropped (reverse water-filling,
[Cover2006]_ theorem 10.3.3).  As the bases are orthonormal, the weights of a cluster all have one
step, whatever their column; a base has steps as much finer as its column carries energy.

t is found by measuring the error itself, so the bound holds for what the file will hold, not for
what the model of rounding foresees.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prtbake_storage.decode.asset import Part
from prtbake_storage.decode.quantise import (
    INT16_MAX,
    OFFSET,
    Scales,
    dequantised,
    factor_peaks,
    finest_scale,
    round_part,
    scale_below,
)
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.rounding_error import (
    RoundingError,
    foreseen_error,
    number_counts,
    number_weights,
    rounding_error,
)

LARGEST_LEVEL = INT16_MAX - OFFSET
"""Of the finest scale: int16 less the offset that the file adds to levels."""

LEVEL_OF_IDLE_COLUMNS = 127
"""A column that no area depends on has 8 bits: the error does not say what it needs."""

LEAST_SHARE = 0.9
"""Of the bound: the search ends with an error between this share of it and all of it."""

AIM = 0.96
"""Share of the bound that the next step aims at."""

MOST_ROUNDS = 40
LARGEST_STRIDE = 16.0
"""Factor by which a step changes in a round at most."""

CLOSE = 1.0 + 1e-3
"""Steps as near as this to each other leave nothing to search between: levels change in jumps."""


@dataclass(frozen=True)
class Allocation:
    """Scales of every rounded factor, and what rounding with them costs.

    Attributes
    ----------
    scales
        As `prtbake_storage.hdf5.writer.write_asset` takes them.
    error
        Measured squared error, weighted by area.
    foreseen
        The same by the model of rounding; too large where columns were dropped.
    meets
        Whether the error is within the bound; where not, the scales are the finest of 16 bits.
    """

    scales: Scales
    error: RoundingError
    foreseen: float
    meets: bool


def allocate_bits(part: Part, areas: Float64[F64, " verts"], bound: float) -> Allocation:
    """Choose the scales of a part.

    Parameters
    ----------
    part
        Exact factors, with orthonormal bases.
    areas
        Weights of the part's vertices, 0 or more.
    bound
        Squared radiance error, weighted by the same areas, that rounding may add; 0 or more.

    Notes
    -----
    The same on any number of threads.  The error is measured one to four times.
    """
    weights = number_weights(part, areas)
    steps_of = Steps(part, weights)

    def allocation(scales: Scales) -> Allocation:
        error = measured(part, scales, areas)
        foreseen = foreseen_error(part, scales, weights)
        return Allocation(scales, error, foreseen, error.total <= bound)

    count = sum(float(np.sum(n * (weights[name] > 0))) for name, n in number_counts(part))
    step = float(np.sqrt(12.0 * bound / max(1.0, count)))
    lower = upper = best = None
    for _ in range(MOST_ROUNDS):
        tried = allocation(steps_of.scales(step))
        if tried.meets:
            best, lower = tried, step
            if tried.error.total >= LEAST_SHARE * bound or steps_of.nothing_left(tried.scales):
                break
        else:
            upper = step
            if steps_of.finest_reached(tried.scales):
                # no smaller step changes anything
                return tried
        if lower is not None and upper is not None and upper <= CLOSE * lower:
            break
        step = _next_step(step, tried.error.total, bound, lower, upper)
    return best if best is not None else allocation(steps_of.scales(0.0))


def measured(part: Part, scales: Scales, areas: Float64[F64, " verts"]) -> RoundingError:
    """Measure what rounding a part with these scales adds."""
    factors: dict[str, Any] = {
        name: dequantised(name, values, scales[name], part.labels)
        for name, values in round_part(part, scales).items()
    }
    return rounding_error(part, replace(part, **factors), areas)


def _next_step(
    step: float, error: float, bound: float, lower: float | None, upper: float | None
) -> float:
    """Take the error to go by the square of the step, within what is known of it."""
    factor = float(np.sqrt(AIM * bound / error)) if error > 0.0 else LARGEST_STRIDE
    guess = step * min(max(factor, 1.0 / LARGEST_STRIDE), LARGEST_STRIDE)
    if lower is not None and upper is not None and not lower < guess < upper:
        return float(np.sqrt(lower * upper))
    return guess


class Steps:
    """Scales of one part at any step t."""

    def __init__(self, part: Part, weights: dict[str, F64]) -> None:
        self._peaks = factor_peaks(part)
        self._weights = {
            name: np.broadcast_to(weights[name], peak.shape) for name, peak in self._peaks.items()
        }
        self._finest = {
            name: finest_scale(peak, LARGEST_LEVEL) for name, peak in self._peaks.items()
        }

    def scales(self, step: float) -> dict[str, Float32[F32, "..."]]:
        """Return s = t / sqrt(g) for all columns, no finer than 16 bits hold."""
        found = {}
        for name, peak in self._peaks.items():
            weight = self._weights[name]
            own = step / np.sqrt(np.where(weight > 0.0, weight, 1.0))
            # beyond twice the peak every level is 0
            scale = scale_below(np.minimum(own, 2.0 * peak))
            scale[own > 2.0 * peak] = 0.0
            scale = np.maximum(scale, np.where(own > 2.0 * peak, 0.0, self._finest[name]))
            idle = finest_scale(peak, LEVEL_OF_IDLE_COLUMNS)
            found[name] = np.where(weight > 0.0, scale, idle).astype(np.float32)
        return found

    def finest_reached(self, scales: Scales) -> bool:
        """Whether every column that weighs anything has the finest of scales."""
        return all(
            bool(np.all((scales[name] == self._finest[name]) | (self._weights[name] == 0.0)))
            for name in scales
        )

    def nothing_left(self, scales: Scales) -> bool:
        """Whether every column that weighs anything is dropped."""
        return all(
            bool(np.all((scales[name] == 0.0) | (self._weights[name] == 0.0))) for name in scales
        )
