"""Rotation of spherical-harmonic light in plain numpy, by an exact quadrature.

Workers rotate by recurrences (`prtbake_workers.basis.sh_rotation`), which is faster; a light is
turned once a picture, and decoders need nothing but numpy.
"""

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.sh import eval_sh, order_of

F64 = NDArray[np.float64]

VALUES_AT_A_TIME = 1 << 22
"""Of functions in directions: 32 MiB."""


def turn_sh(coefficients: F64, rotation: F64) -> F64:
    """Give the coefficients (n^2, channels) of f(R^T d) from those of f.

    The coefficient k is the integral of y_k(d) f(R^T d): n Gauss-Legendre heights and 2 n azimuths
    integrate every product of two functions below order n exactly, here to rounding.

    Parameters
    ----------
    coefficients
        (n^2, channels).
    rotation
        (3, 3), proper and orthogonal.
    """
    order = order_of(len(coefficients))
    heights, height_weights = np.polynomial.legendre.leggauss(order)
    azimuths = np.arange(2 * order) * (np.pi / order)
    z = np.repeat(heights, 2 * order)
    around = np.sqrt(1.0 - z * z)
    azimuth = np.tile(azimuths, order)
    directions = np.stack([around * np.cos(azimuth), around * np.sin(azimuth), z], axis=1)
    weights = np.repeat(height_weights, 2 * order) * (np.pi / order)
    turned = np.zeros_like(coefficients)
    step = max(1, VALUES_AT_A_TIME // order**2)
    for start in range(0, len(directions), step):
        block = slice(start, start + step)
        # R^T d, as rows
        values = eval_sh(order, directions[block] @ rotation) @ coefficients
        turned += eval_sh(order, directions[block]).T @ (weights[block, None] * values)
    return turned
