"""Texels cut fine enough for the functions that are integrated over them."""

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.environment import Environment, texel_of
from prtbake_workers.environment.fit.cells import Cells

COARSEST_RAD = 0.03
"""Pieces stand for their light at their middle: at 0.05 rad five bands of a constant are off by a
squared error of 4e-7, which falls with the fourth power."""


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


def fine_texels(environment: Environment, finest: float) -> Cells:
    """Give pieces no wider than ``finest``, nor than `COARSEST_RAD`, as samples of the light."""
    directions, solid_angles, radiance = subdivided_texels(environment, min(finest, COARSEST_RAD))
    return Cells(directions, radiance, solid_angles)
