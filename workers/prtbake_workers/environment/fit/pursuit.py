"""Seed a lobe where the residual asks for one most, and find the lobes that matter least."""

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.fit.objective import (
    Lobes,
    Projection,
    SquaredError,
    evaluate_lobes,
)
from prtbake_workers.environment.fit.refine import narrowest_bandwidths, refine

_MAX_CANDIDATES = 200
_WIDENINGS = 4.0 ** -np.arange(6)
_REPLACED_SHARE = 16
_TRIES = 4


def with_best_lobe(
    lobes: Lobes,
    cells: Cells,
    residual: Float64[F64, "cells 3"],
    place: Float64[F64, " 3"],
    search_rad: float,
) -> Lobes:
    """Add the lobe around a place that explains most of the squared residual there.

    Matching pursuit: of the cells around with the strongest residual and six bandwidths, the pair
    with the largest (r, G)^2 / (G, G), which is what a lobe with its best coefficient takes off.
    """
    near = np.flatnonzero(cells.directions @ place >= np.cos(search_rad))
    weights, around = cells.solid_angles[near], cells.directions[near]
    wanted = weights[:, None] * residual[near]
    order = np.argsort(np.abs(wanted).sum(axis=1), kind="stable")[::-1]
    candidates = around[order[:_MAX_CANDIDATES]]
    narrowest = narrowest_bandwidths(cells, candidates)
    best_gain, best = -1.0, (candidates[0], narrowest[0])
    for widening in _WIDENINGS:
        bandwidths = narrowest * widening
        kernel = evaluate_lobes(Lobes(candidates, bandwidths), around)
        gain = ((kernel.T @ wanted) ** 2).sum(axis=1) / (weights @ kernel**2)
        i = int(np.argmax(gain))
        if gain[i] > best_gain:
            best_gain, best = float(gain[i]), (candidates[i], bandwidths[i])
    return Lobes(
        np.concatenate([lobes.centres, best[0][None]]), np.append(lobes.bandwidths, best[1])
    )


def reseed(objective: SquaredError, lobes: Lobes) -> Lobes:
    """Move the lobes that matter least to where the residual is largest, as long as that helps.

    The squared error has many minima: two lobes that settled on one feature do not part again by
    descent.  A try that does not lower the error is taken back, and ends the search.
    """
    best = objective.project(lobes)
    n_replaced = max(1, len(lobes.bandwidths) // _REPLACED_SHARE)
    for _ in range(_TRIES):
        kept = np.argsort(_removal_costs(objective, lobes, best), kind="stable")[n_replaced:]
        tried = Lobes(lobes.centres[np.sort(kept)], lobes.bandwidths[np.sort(kept)])
        for _ in range(n_replaced):
            coefficients = objective.project(tried).coefficients
            cells = objective.cells
            residual = cells.radiance - evaluate_lobes(tried, cells.directions) @ coefficients
            worst = np.argmax(cells.solid_angles * np.abs(residual).sum(axis=1))
            tried = with_best_lobe(tried, cells, residual, cells.directions[worst], np.pi)
        tried = refine(objective, tried, free="both", max_steps=30)
        found = objective.project(tried)
        if found.error >= best.error:
            break
        lobes, best = tried, found
    return lobes


def _removal_costs(
    objective: SquaredError, lobes: Lobes, best: Projection
) -> Float64[F64, " lobes"]:
    """Give the rise of the error if a lobe is left out and the others adjust.

    For least squares it is |L_j|^2 / (G^-1)_jj with the regularised Gram matrix G.
    """
    inverse = np.linalg.inv(objective.gram(lobes))
    return np.asarray((best.coefficients**2).sum(axis=1) / np.diag(inverse))
