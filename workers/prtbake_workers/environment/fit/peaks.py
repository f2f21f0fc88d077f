"""Narrow lobes for suns and lamps, seeded at the largest residuals one by one.

The squared error of a map with a sun is that of its sun: the sky is a hundred-thousandth of it, and
an optimiser that starts from both would spend every lobe on the disc.  So the light is split into
a clipped map, which is fitted as section 5.3 of [Tsai2006]_ says, and what exceeds it.
"""

import numpy as np
from scipy.spatial import cKDTree

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.environment.environment import LUMINANCE
from prtbake_workers.environment.fit.cells import Cells, adaptive_cells, cell_of, clip_level
from prtbake_workers.environment.fit.objective import Lobes, SquaredError, evaluate_lobes
from prtbake_workers.environment.fit.pursuit import with_best_lobe
from prtbake_workers.environment.fit.refine import refine

ENOUGH = 0.05
"""Residual power, as a share of all the light's, at which no more peak lobes are added."""

_FACE_CELLS = 32
_MAX_CELLS = 16000
_SEARCH_RAD = np.radians(4.0)
_REFINE_EVERY = 6


def split_peaks(texels: Cells) -> tuple[Cells, Cells]:
    """Split the light at ``clip_level`` into a clipped map and the peaks above it."""
    luminance = texels.radiance @ LUMINANCE
    level = clip_level(luminance, texels.solid_angles)
    kept = np.ones_like(luminance)
    np.divide(level, luminance, out=kept, where=luminance > level)
    clipped = texels.radiance * kept[:, None]
    return texels._replace(radiance=clipped), texels._replace(radiance=texels.radiance - clipped)


def fit_peaks(peaks: Cells, total_power: float, n_most: int) -> Lobes:
    """Place lobes on the peaks until ``ENOUGH`` is explained, at most ``n_most``.

    Each step takes the part of the sphere whose residual has the most power (not energy, or the
    brightest peak would take all the lobes), there the centre and bandwidth that lower the squared
    error most (matching pursuit), and every few steps refines all of them together.
    """
    lobes = Lobes(np.zeros((0, 3)), np.zeros(0))
    if n_most < 1 or not (peaks.radiance > 0).any():
        return lobes
    cells = _near_peaks(adaptive_cells(peaks, _FACE_CELLS, _MAX_CELLS))
    objective = SquaredError(cells)
    _, region = np.unique(cell_of(cells.directions, 2 * _FACE_CELLS), return_inverse=True)
    residual = cells.radiance
    for n in range(1, n_most + 1):
        power = cells.solid_angles * np.abs(residual).sum(axis=1)
        worst = cells.directions[_worst(region, power)]
        lobes = with_best_lobe(lobes, cells, residual, worst, _SEARCH_RAD)
        if n % _REFINE_EVERY == 0 or n < _REFINE_EVERY:
            lobes = refine(objective, lobes, free="both", max_steps=15)
        coefficients = objective.project(lobes).coefficients
        residual = cells.radiance - evaluate_lobes(lobes, cells.directions) @ coefficients
        left = float(cells.solid_angles @ np.abs(residual) @ LUMINANCE)
        if left < ENOUGH * total_power:
            break
    return refine(objective, lobes, free="both", max_steps=30)


def _near_peaks(cells: Cells) -> Cells:
    """Leave out the cells so far from every peak that narrow lobes are nothing there."""
    tree = cKDTree(cells.directions[(cells.radiance > 0).any(axis=1)])
    distance, _ = tree.query(cells.directions)
    return Cells(*(part[distance < 2 * np.sin(_SEARCH_RAD / 2)] for part in cells))


def _worst(region: Int64[I64, " cells"], power: Float64[F64, " cells"]) -> int:
    """Give the cell with most residual power in the region that has most."""
    inside = np.flatnonzero(region == np.argmax(np.bincount(region, power)))
    return int(inside[np.argmax(power[inside])])
