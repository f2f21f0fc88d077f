"""The energy lost off the grid, where the grid's own figure means little."""

from dataclasses import replace
from typing import TypeVar

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid, azimuthal_blocks, norm_of_order
from prtbake_workers.percent import percent

Found = TypeVar("Found", bound=Factorisation)

GRID_TOLERANCE = 0.1
"""Relative change of the squared norm on a finer grid above which the note warns; on 28 x 112 it is
0.02 for Cook-Torrance m 0.2, 0.08 for Phong 200, 0.26 for m 0.1."""

CHECK_GRID = (122, 480)
"""Rings and azimuths on which such a lobe is measured: four digits at Cook-Torrance m 0.05."""


def with_measured_loss(found: Found, lost: float, ratio: float) -> Found:
    """State what was measured on a finer grid, and why.

    Parameters
    ----------
    lost
        Share of the energy that the terms lose in truth.
    ratio
        Squared norm of the BRDF on the grid over that on a finer one.

    Raises
    ------
    BrdfError
        The sum misses more than the whole energy.
    """
    grid = f"the grid of {found.grid.n_theta} x {found.grid.n_phi}"
    if lost > 1.0:
        raise BrdfError(
            f"{found.n_terms} terms on {grid} miss {lost:.0%} of the BRDF's energy, more than none "
            "at all would: its lobe is too narrow, widen it or ask for fewer terms",
            pointer="/brdf",
        )
    note = (
        f"{grid} does not resolve the lobe (squared norm {ratio:.2f} of that on a finer one): the "
        f"terms lose {percent(found.energy_lost)} of the energy there, {percent(lost)} in truth"
    )
    return replace(found, energy_lost=lost, note=f"{found.note}; {note}" if found.note else note)


def norm_ratio(brdf: Brdf, grid: HemisphereGrid) -> float:
    """Return the squared norm over that on a grid twice as fine.

    Far from 1, by more than `GRID_TOLERANCE`, the lobe slips between the grid's nodes.
    """
    fine = HemisphereGrid(2 * grid.n_theta, 2 * grid.n_phi)
    return _squared_norm(brdf, grid) / _squared_norm(brdf, fine)


def _squared_norm(brdf: Brdf, grid: HemisphereGrid) -> float:
    """Squared norm of the BRDF with the weight cos_i^2 cos_o^2, by the grid's quadrature."""
    blocks = azimuthal_blocks(brdf, grid.cosines, grid.cosines, grid.n_phi)
    weight = grid.cosines**2 * grid.ring_weight
    orders = np.arange(len(blocks), dtype=np.int32)
    energy = np.einsum("mioc,mioc,i,o->m", blocks, blocks, weight, weight, optimize=True)
    return float(np.sum(energy / norm_of_order(orders)))
