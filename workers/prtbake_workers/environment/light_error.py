"""What a fitted light leaves of an environment, over the sphere and in radiance."""

import numpy as np

from prtbake_storage.decode.light import FittedLight, Light
from prtbake_workers.environment.environment import LUMINANCE
from prtbake_workers.environment.fit.cells import Cells

_ROWS_AT_A_TIME = 1 << 16


def squared_error_ratio(light: Light, texels: Cells) -> float:
    """Give the squared error over the squared radiance, both over the sphere and the channels.

    A sum of squares of differences, texel by texel: nothing cancels near a perfect fit.  0 for a
    black light that is fitted by nothing, infinity for a black one that is not.
    """
    error = 0.0
    for start in range(0, len(texels.solid_angles), _ROWS_AT_A_TIME):
        rows = slice(start, start + _ROWS_AT_A_TIME)
        left = texels.radiance[rows] - light.radiance(texels.directions[rows])
        error += float(texels.solid_angles[rows] @ (left**2).sum(axis=1))
    if texels.energy == 0.0:
        return 0.0 if error == 0.0 else np.inf
    return error / texels.energy


def power_ratio(light: FittedLight, texels: Cells) -> float:
    """Give the luminance that a light sends out in all over that of the texels; 1 if both are 0."""
    power = float(texels.solid_angles @ (texels.radiance @ LUMINANCE))
    own = float(light.power @ LUMINANCE)
    if power == 0.0:
        return 1.0 if own == 0.0 else np.inf
    return own / power
