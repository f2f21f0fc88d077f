"""Environments as spherical-harmonic light."""

import numpy as np

from prtbake_storage.decode.sh import check_order, eval_sh
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64

LIGHT_VALUES = 1 << 18
"""Basis values a block while an environment is integrated: 2 MiB."""


def sh_light(
    order: int,
    directions: Float64[F64, "texels 3"],
    solid_angles: Float64[F64, " texels"],
    radiance: Float64[F64, "texels 3"],
) -> Float64[F64, "coeffs 3"]:
    """Project a sampled environment on spherical harmonics: ``sum_w y_k(w) L(w) dw``.

    Parameters
    ----------
    order
        n >= 1: n^2 coefficients a channel.
    directions, solid_angles, radiance
        Texels of the environment: unit vectors, steradians that sum to 4 pi, linear radiance.

    Returns
    -------
    ndarray
        The light's coefficients; their dot product with those of a transfer function is the
        integral of light times transfer.  `rotate_sh` on the transpose turns the light.

    Raises
    ------
    SettingsError
        Solid angles that do not cover the sphere; a direction that is no unit vector.
    """
    check_order(order)
    total = float(solid_angles.sum())
    if not abs(total / (4.0 * np.pi) - 1.0) < 1e-6:
        raise SettingsError(f"solid angles must sum to 4 pi, got {total:.6g}")
    light = np.zeros((order * order, 3))
    step = max(1, LIGHT_VALUES // order**2)
    for start in range(0, len(directions), step):
        block = slice(start, start + step)
        flux = radiance[block] * solid_angles[block, None]
        light += eval_sh(order, directions[block]).T @ flux
    return light
