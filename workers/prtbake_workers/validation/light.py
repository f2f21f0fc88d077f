"""The environment as light for the chain: shared samples and cell fluxes."""

import numpy as np
from scipy.spatial import cKDTree

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.environment.subdivision import subdivided_texels
from prtbake_workers.transport.directions import CubeDirections
from prtbake_workers.transport.reference import LightPass


def draw_pass(
    sampler: EnvironmentSampler,
    rotation: Float64[F64, "3 3"],
    n_samples: int,
    rng: np.random.Generator,
) -> LightPass:
    """Draw one pass of samples from the turned light L'(d) = L(R^T d)."""
    samples = sampler.sample(n_samples, rng)
    weights = samples.radiance / (samples.pdf[:, None] * n_samples)
    return LightPass(samples.directions @ rotation.T, weights)


def cell_flux(
    environment: Environment, rotation: Float64[F64, "3 3"], cells: CubeDirections
) -> Float64[F64, "dirs 3"]:
    """Integrate the turned light over the cell of each sampling direction."""
    spacing = np.sqrt(4.0 * np.pi / len(cells.directions))
    directions, solid_angles, radiance = subdivided_texels(environment, 0.5 * spacing)
    _, owner = cKDTree(cells.directions).query(directions @ rotation.T)
    flux = radiance * solid_angles[:, None]
    return np.stack(
        [np.bincount(owner, flux[:, c], len(cells.directions)) for c in range(3)], axis=1
    )
