"""Refine centres and bandwidths by L-BFGS-B, the coefficients solved at every evaluation."""

import time
from collections.abc import Callable
from typing import Literal

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.deadline import time_for
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.fit.objective import Lobes, SquaredError

Free = Literal["centres", "bandwidths", "both"]

WIDEST_BANDWIDTH = 0.05
"""Almost constant over the sphere: wider lobes would only be copies of each other."""

MOST_WIDTHS_MOVED = 1.5
"""How far a centre may move in its tangent plane before the chart is laid anew, in widths."""

OnStep = Callable[[], None]


def refine(
    objective: SquaredError,
    lobes: Lobes,
    *,
    free: Free,
    max_steps: int,
    tolerance: float = 1e-4,
    on_step: OnStep | None = None,
) -> Lobes:
    """Lower the squared error over centres, bandwidths, or both.

    A centre moves in the tangent plane at where it starts, xi = normalise(xi_0 + s (a t_1 + b
    t_2)), with a and b in units of the lobe's width s = 1 / sqrt(lam) so that all variables
    have one scale; a bandwidth varies as log lam.  No lobe becomes narrower than the cell it is in
    can show (``narrowest_bandwidths``).

    A lobe that has moved among larger cells is widened to what those can show.  Where a deadline
    leaves no time for another step, the lobes are those of the last one.
    """
    if not time_for(0.0):
        return lobes
    chart = _Chart(lobes)
    n = len(lobes.bandwidths)
    moves = 2 * n if free != "bandwidths" else 0
    narrowest = narrowest_bandwidths(objective.cells, lobes.centres)
    start_log = np.log(np.clip(lobes.bandwidths, WIDEST_BANDWIDTH, narrowest))
    bounds = [(-MOST_WIDTHS_MOVED, MOST_WIDTHS_MOVED)] * moves
    if free != "centres":
        bounds += [(np.log(WIDEST_BANDWIDTH), float(np.log(b))) for b in narrowest]

    def lobes_at(x: F64) -> Lobes:
        centres = chart.centres(x[:moves]) if moves else lobes.centres
        return Lobes(centres, np.exp(x[moves:] if free != "centres" else start_log))

    # L-BFGS-B measures progress against max(error, 1), so the error is counted from 1
    unit = objective.project(lobes).error
    if unit <= 0.0:
        return lobes

    def value_and_gradient(x: F64) -> tuple[float, F64]:
        error, _, gradient = objective.project(lobes_at(x))
        parts = []
        if moves:
            parts.append(chart.pull_back(x[:moves], gradient.centres))
        if free != "centres":
            parts.append(gradient.log_bandwidths)
        return error / unit, np.concatenate(parts) / unit

    start = np.concatenate([np.zeros(moves), start_log if free != "centres" else np.zeros(0)])
    outcome = minimize(
        value_and_gradient,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        callback=_after_step(on_step),
        options={"maxiter": max_steps, "maxfun": 2 * max_steps, "ftol": tolerance, "maxcor": 20},
    )
    moved = lobes_at(outcome.x)
    narrowest = narrowest_bandwidths(objective.cells, moved.centres)
    return moved._replace(bandwidths=np.minimum(moved.bandwidths, narrowest))


def _after_step(on_step: OnStep | None) -> Callable[[F64], None]:
    """Return what `minimize` calls after a step, and which ends it where there is no more time."""
    longest, since = 0.0, time.monotonic()

    def after(_x: F64) -> None:
        nonlocal longest, since
        if on_step is not None:
            on_step()
        now = time.monotonic()
        longest, since = max(longest, now - since), now
        if not time_for(longest):
            raise StopIteration

    return after


def narrowest_bandwidths(cells: Cells, centres: Float64[F64, "lobes 3"]) -> Float64[F64, " lobes"]:
    """Give the bandwidth at which a lobe's integral is four times the solid angle of its cell.

    On a square lattice the sum over the cells then is the integral to 1e-5 wherever the centre
    lies, 2 exp(-4 pi) by Poisson summation, so that lobes of opposite sign that shape a sun keep
    its power; at twice the solid angle it would be 0.4 %, and such a sun was 3 % too strong.
    """
    _, nearest = cKDTree(cells.directions).query(centres)
    return np.asarray(np.pi / 2 / cells.solid_angles[nearest])


class _Chart:
    """Tangent planes at the centres, in units of the lobes' widths."""

    def __init__(self, lobes: Lobes) -> None:
        self._origins = lobes.centres
        width = 1 / np.sqrt(np.maximum(lobes.bandwidths, 1.0))
        aside = np.eye(3)[np.argmin(np.abs(lobes.centres), axis=1)]
        first = np.cross(lobes.centres, aside)
        first /= np.linalg.norm(first, axis=1, keepdims=True)
        second = np.cross(lobes.centres, first)
        self._axes = np.stack([first, second], axis=1) * width[:, None, None]

    def centres(self, x: Float64[F64, " variables"]) -> Float64[F64, "lobes 3"]:
        """Map two coordinates a lobe to unit centres."""
        moved = self._moved(x)
        return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))

    def pull_back(
        self, x: Float64[F64, " variables"], gradient: Float64[F64, "lobes 3"]
    ) -> Float64[F64, " variables"]:
        """Turn a derivative by the unit centres into one by the coordinates."""
        moved = self._moved(x)
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        unit = moved / length
        tangent = (gradient - (gradient * unit).sum(axis=1, keepdims=True) * unit) / length
        return np.asarray(np.einsum("jai,ji->ja", self._axes, tangent).ravel())

    def _moved(self, x: Float64[F64, " variables"]) -> Float64[F64, "lobes 3"]:
        return np.asarray(self._origins + np.einsum("ja,jai->ji", x.reshape(-1, 2), self._axes))
