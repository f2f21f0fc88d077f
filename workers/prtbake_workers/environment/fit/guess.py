"""First guess of centres and bandwidths: coverage and a priority queue ([Tsai2006]_ 5.3)."""

import numpy as np

from prtbake_workers.arrays import B8, F64, Bool, Float64
from prtbake_workers.environment.environment import LUMINANCE
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.fit.objective import Lobes

DIFFERS = 0.1
"""A direction differs from another where the squared difference of their radiance exceeds this
share of the light's variance over the sphere."""

ALLOWED_SHARE = 0.1
"""Share of differing directions that a coverage may hold."""

SHRINK = 0.8
"""Factor on all coverages when every direction is marked and lobes are still to be placed."""

WIDEST_RAD = np.pi / 2
_ROWS_AT_A_TIME = 512


def guess_lobes(cells: Cells, n_lobes: int, rng: np.random.Generator) -> Lobes:
    """Choose centres by coverage-weighted radiance, and bandwidths 1 / coverage^2.

    A chosen direction marks all within its coverage; when all are marked, coverages shrink, the
    marks are renewed and the queue is walked again.  Directions of equal priority (an even sky)
    come in random order.  No direction is chosen twice: there are at most as many lobes as cells.
    """
    coverage = estimate_coverage(cells)
    priority = coverage * np.maximum(cells.radiance @ LUMINANCE, 0.0)
    shuffled = rng.permutation(len(priority))
    queue = shuffled[np.argsort(-priority[shuffled], kind="stable")]
    chosen: list[int] = []
    marked = np.zeros(len(queue), dtype=bool)
    n_lobes = min(n_lobes, len(queue))
    while len(chosen) < n_lobes:
        for j in queue:
            if marked[j]:
                continue
            chosen.append(int(j))
            marked |= _within(cells, int(j), coverage[j])
            if len(chosen) == n_lobes or marked.all():
                break
        if len(chosen) < n_lobes:
            coverage = coverage * SHRINK
            marked[:] = False
            for j in chosen:
                marked |= _within(cells, j, coverage[j])
    centres = np.array(chosen)
    return Lobes(cells.directions[centres], 1.0 / coverage[centres] ** 2)


def estimate_coverage(cells: Cells) -> Float64[F64, " cells"]:
    """Give the angle of the widest cone about each direction in which few directions differ."""
    n = len(cells.solid_angles)
    spacing = np.sqrt(4 * np.pi / n)
    mean = cells.solid_angles @ cells.radiance / cells.solid_angles.sum()
    variance = float(cells.solid_angles @ ((cells.radiance - mean) ** 2).sum(axis=1)) / (4 * np.pi)
    threshold = DIFFERS * variance
    squared = (cells.radiance**2).sum(axis=1)
    coverage = np.empty(n)
    ranks = np.arange(1, n + 1)
    for first in range(0, n, _ROWS_AT_A_TIME):
        rows = slice(first, min(first + _ROWS_AT_A_TIME, n))
        cosines = cells.directions[rows] @ cells.directions.T
        order = np.argsort(-cosines, axis=1, kind="stable")
        difference = squared[rows, None] + squared - 2 * cells.radiance[rows] @ cells.radiance.T
        # rounding leaves a residue where nothing differs at all
        differs = difference > threshold + 1e-9 * (squared[rows, None] + squared)
        share = np.cumsum(np.take_along_axis(differs, order, axis=1), axis=1) / ranks
        inside = np.argmax(share > ALLOWED_SHARE, axis=1) - 1
        inside[~(share > ALLOWED_SHARE).any(axis=1)] = n - 1
        farthest = np.take_along_axis(order, np.maximum(inside, 0)[:, None], axis=1)
        cosine = np.take_along_axis(cosines, farthest, axis=1)[:, 0]
        coverage[rows] = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.clip(coverage, spacing, WIDEST_RAD)


def _within(cells: Cells, j: int, angle_rad: float) -> Bool[B8, " cells"]:
    """Mark the directions within an angle of direction j, itself included."""
    inside = np.asarray(cells.directions @ cells.directions[j] >= np.cos(angle_rad))
    inside[j] = True
    return inside
