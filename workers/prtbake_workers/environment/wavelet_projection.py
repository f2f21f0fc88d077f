"""Environments in the largest Haar wavelets of a cube map, after [Ng2003]_."""

from dataclasses import replace

import numpy as np

from prtbake_storage.decode.cube_map import N_FACES, cube_texel_of
from prtbake_storage.decode.haar import MOST_RESOLUTION
from prtbake_storage.decode.light import WaveletLight
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.wavelet import haar, largest_coefficients, support_areas
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.light_error import squared_error_ratio
from prtbake_workers.environment.subdivision import fine_texels

_SAMPLES_ACROSS = 6
"""Rows of samples in a texel in the middle of a face of the cube map."""


def project_wavelet(
    texels: Cells, resolution: int, n_coefficients: int, *, area_weighted: bool = False
) -> WaveletLight:
    """Keep the wavelets that hold most of a light's squared radiance over the sphere.

    Parameters
    ----------
    texels
        Samples of which some fall into every texel of the cube map (`wavelet_samples`).
    resolution
        N, a power of two: the cube map has 6 N^2 texels.
    n_coefficients
        Wavelets kept, each with three channels.
    area_weighted
        Keep those that hold most flux instead, as [Ng2003]_ does for pictures: the light has a
        larger error.

    Returns
    -------
    WaveletLight
        With its squared-error ratio on the samples, that of merging them into texels included.

    Raises
    ------
    SettingsError
        A resolution that is no power of two, more wavelets than texels, or a texel of the cube
        map without a sample.
    """
    cube = cube_map_of(texels, resolution)
    if not 1 <= n_coefficients <= len(cube):
        raise SettingsError(
            f"n_wavelets is {n_coefficients}: a cube map of resolution {resolution} has "
            f"{len(cube)}",
            pointer="/settings/n_wavelets",
        )
    coefficients = haar(cube, resolution)
    weights = support_areas(resolution) if area_weighted else None
    kept = largest_coefficients(coefficients, n_coefficients, weights)
    light = WaveletLight(
        resolution=resolution,
        indices=kept.astype(np.int32),
        coefficients=coefficients[kept],
    )
    return replace(light, error=squared_error_ratio(light, texels))


def cube_map_of(texels: Cells, resolution: int) -> Float64[F64, "cube 3"]:
    """Give the mean radiance of the samples in every texel of a cube map."""
    if not 1 <= resolution <= MOST_RESOLUTION or resolution & (resolution - 1):
        raise SettingsError(
            f"resolution is {resolution}: a power of two up to {MOST_RESOLUTION}",
            pointer="/settings/resolution",
        )
    owner = cube_texel_of(texels.directions, resolution)
    n = N_FACES * resolution**2
    areas = np.bincount(owner, texels.solid_angles, n)
    if (areas == 0.0).any():
        raise SettingsError(
            f"texel {int(np.argmin(areas))} of a cube map of resolution {resolution} holds no "
            "sample of the light",
            pointer="/settings/resolution",
        )
    flux = [np.bincount(owner, texels.solid_angles * c, n) for c in texels.radiance.T]
    return np.stack(flux, axis=1) / areas[:, None]


def wavelet_samples(environment: Environment, resolution: int) -> Cells:
    """Cut the texels of a map so that several fall into every texel of the cube map.

    In the corner of a face, where texels are a third as wide as in its middle, at least one does.
    """
    return fine_texels(environment, finest_of_wavelets(resolution))


def finest_of_wavelets(resolution: int) -> float:
    """Give the width of the samples, in radians."""
    return 2.0 / resolution / _SAMPLES_ACROSS
