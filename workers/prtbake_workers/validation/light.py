"""The environment as light for the chain: shared samples, cell fluxes, exact integrals."""

import numpy as np
from scipy.spatial import cKDTree

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.environment import Environment, texel_of
from prtbake_workers.environment.sampling import EnvironmentSampler
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


def subdivided_texels(
    environment: Environment, finest: float
) -> tuple[Float64[F64, "dirs 3"], Float64[F64, " dirs"], Float64[F64, "dirs 3"]]:
    """Cut texels into pieces no wider than ``finest`` radians.

    Returns directions, solid angles (sum 4 pi) and radiance, so that sums over them integrate
    smooth functions against a map that is constant over each texel.
    """
    times = max(1, int(np.ceil(np.pi / environment.height / finest)))
    height, width = environment.height * times, environment.width * times
    fine = Environment(np.zeros((height, width, 3), np.float32))
    directions = fine.directions()
    owner = texel_of(directions, environment.height, environment.width)
    radiance = environment.radiance.reshape(-1, 3)[owner].astype(np.float64)
    return directions, fine.solid_angles(), radiance


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
