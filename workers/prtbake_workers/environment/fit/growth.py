"""Add lobes to a fit where it leaves most, and let all settle: a warm start with more lobes."""

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.fit.cells import Cells, adaptive_cells, cell_of
from prtbake_workers.environment.fit.objective import Lobes, SquaredError, evaluate_lobes
from prtbake_workers.environment.fit.pursuit import with_best_lobe
from prtbake_workers.environment.fit.refine import refine
from prtbake_workers.environment.fit.scattered import face_cells

_REGION_FACE_CELLS = 16
_SEARCH_RAD = np.radians(20.0)
"""Around the worst place: wider lobes than this the first fit has placed."""

_BATCH_SHARE = 8
"""One lobe in so many is added before the coefficients of all are solved again."""


def grow(texels: Cells, lobes: Lobes, n_lobes: int, max_steps: int) -> Lobes:
    """Add lobes until there are ``n_lobes``, then refine centres and bandwidths of all.

    Each new lobe stands in the region of 5.6 degrees that holds most of the squared error, with
    the centre and bandwidth that take off most of it (matching pursuit), as narrow as the texels
    there can show: a sun that the first lobes blurred gets its own.

    Parameters
    ----------
    texels
        The light.
    lobes
        Of a fit.
    n_lobes
        No fewer than those.
    max_steps
        Of the descent at the end.
    """
    cells = adaptive_cells(texels, face_cells(n_lobes, 32), 96 * n_lobes + 4096)
    n_lobes = min(n_lobes, len(cells.solid_angles))
    objective = SquaredError(cells)
    _, region = np.unique(cell_of(cells.directions, _REGION_FACE_CELLS), return_inverse=True)
    while len(lobes.bandwidths) < n_lobes:
        coefficients = objective.project(lobes).coefficients
        residual = cells.radiance - evaluate_lobes(lobes, cells.directions) @ coefficients
        n_now = len(lobes.bandwidths)
        for _ in range(min(n_lobes - n_now, max(1, n_now // _BATCH_SHARE))):
            energy = cells.solid_angles * (residual**2).sum(axis=1)
            inside = np.flatnonzero(region == np.argmax(np.bincount(region, energy)))
            place = cells.directions[inside[np.argmax(energy[inside])]]
            lobes = with_best_lobe(lobes, cells, residual, place, _SEARCH_RAD)
            residual = _without(residual, lobes, cells)
    return refine(objective, lobes, free="both", max_steps=max_steps)


def _without(
    residual: Float64[F64, "cells 3"], lobes: Lobes, cells: Cells
) -> Float64[F64, "cells 3"]:
    """Take off what the last lobe explains by itself, so that the next one looks elsewhere."""
    last = Lobes(lobes.centres[-1:], lobes.bandwidths[-1:])
    values = evaluate_lobes(last, cells.directions)[:, 0]
    weighted = cells.solid_angles * values
    return residual - np.outer(values, (weighted @ residual) / (weighted @ values))
