"""The one term of a BRDF that is a constant."""

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid

CONSTANT_TOLERANCE = 1e-12
"""Relative spread below which a BRDF counts as constant: rounding of the diffuse models."""


def constant_factorisation(
    value: Float64[F64, " channels"],
    grid: HemisphereGrid,
    brdf: Brdf,
    n_terms: int | None,
    n_nodes: int,
) -> AzimuthalFactorisation:
    """Make the one term of a diffuse BRDF: psi = 1 / pi, phi = albedo."""
    albedo = np.pi * value
    projected = 2.0 * np.pi * float(np.sum(grid.cosines**2)) * grid.ring_weight
    needless = n_terms is not None and n_terms > 1
    return AzimuthalFactorisation(
        grid=grid,
        orders=np.zeros(1, np.int32),
        parity=np.zeros(1, np.int32),
        psi_radial=np.full((grid.n_theta, 1), 1.0 / np.pi),
        phi_radial=np.tile(albedo, (grid.n_theta, 1, 1)),
        singular_values=np.array([float(np.linalg.norm(value)) * projected]),
        psi_table=np.full((n_nodes, 1), 1.0 / np.pi, np.float32),
        phi_table=np.tile(albedo.astype(np.float32), (n_nodes, 1, 1)),
        energy_lost=0.0,
        requested_terms=n_terms,
        note=f"a constant BRDF needs 1 term, not {n_terms}" if needless else None,
        is_constant_phi=True,
        brdf=brdf,
    )


def is_constant(blocks: Float64[F64, "orders theta theta channels"]) -> bool:
    """Tell a constant BRDF by its azimuthal orders on a grid, see `azimuthal_blocks`."""
    scale = CONSTANT_TOLERANCE * blocks[0].max(axis=(0, 1))
    level = (np.ptp(blocks[0], axis=(0, 1)) <= scale).all()
    return bool(level and (np.abs(blocks[1:]).max(axis=(0, 1, 2)) <= scale).all())
