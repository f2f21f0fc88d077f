"""Pre-filtered textures of the view side, for shading on the GPU and in the numpy decoder."""

from typing import NamedTuple

import numpy as np

from prtbake_storage.decode.view_map import (
    hemi_octahedral,
    hemi_octahedral_inverse,
    lookup,
    texel_centres,
)
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.brdf.factorisation import Factorisation

VALUES_A_PASS = 1_000_000
"""Values of phi evaluated at once: bounds the memory of large textures to some tens of MiB."""

SMALLEST, LARGEST = 64, 256
"""Texels along a side: the first that is tried, and the last, 16 MiB a channel at 64 terms."""

ERROR_TOLERANCE = 0.003
"""Share of the radiance (amplitude) that a lookup may be off by before the texels are halved."""

PROBES = 4096
"""Directions that the error is measured in: it moves by a tenth of itself from set to set."""


class FittedTexture(NamedTuple):
    """A view texture and the share of the radiance (amplitude) that lookups in it are off by."""

    values: Float32[F32, "rows columns terms channels"]
    error: float

    @property
    def resolution(self) -> int:
        """Texels along a side."""
        return len(self.values)


def fit_view_texture(
    factorisation: Factorisation,
    *,
    tolerance: float = ERROR_TOLERANCE,
    largest: int = LARGEST,
) -> FittedTexture:
    """Double the texture's resolution until lookups are off by at most ``tolerance``.

    The highest azimuthal order does not say how fine the texels must be: Phong 200 in 15 terms has
    orders up to 4 only, and rings that need 256 texels.  So the error is measured.

    Parameters
    ----------
    largest
        Resolution beyond which a larger error is accepted.
    """
    resolution = min(SMALLEST, largest)
    while True:
        values = view_texture(factorisation, resolution)
        error = lookup_error(factorisation, values)
        if error <= tolerance or 2 * resolution > largest:
            return FittedTexture(values, error)
        resolution *= 2


def lookup_error(
    factorisation: Factorisation, texture: Float32[F32, "rows columns terms channels"]
) -> float:
    """Measure the amplitude error of looked-up radiance, weight cos_i^2 cos_o^2, 0 or more.

    The light sides are orthogonal, so terms add in squares, each with its singular value.
    """
    rng = np.random.default_rng(0)
    cosine, azimuth = rng.random(PROBES), 2.0 * np.pi * rng.random(PROBES)
    sine = np.sqrt(1.0 - cosine**2)
    wo: Float64[F64, "probes 3"] = np.stack(
        [sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1
    )
    phi = factorisation.eval_phi(wo)
    off = lookup(texture, hemi_octahedral(wo)) - phi
    weight = cosine[:, None, None] * factorisation.singular_values[: len(phi[0]), None]
    return float(np.linalg.norm(weight * off) / np.linalg.norm(weight * phi))


def view_texture(
    factorisation: Factorisation, resolution: int = 64, supersample: int = 4
) -> Float32[F32, "rows columns terms channels"]:
    """Average phi over the texels of the hemi-octahedral map.

    Parameters
    ----------
    resolution
        Texels along each side of the square, at least 2.
    supersample
        Samples along each side of a texel, at least 1, averaged in the map.

    Notes
    -----
    Halving the texel divides the error of a bilinear lookup by about 3.5.  At 64 texels and 16
    terms it is 0.2 % of the radiance for Cook-Torrance m 0.5 and 0.3 % for Phong 10 (amplitude).
    """
    if resolution < 2:
        raise SettingsError(f"the view texture's resolution must be at least 2, got {resolution}")
    if supersample < 1:
        raise SettingsError(f"supersample must be at least 1, got {supersample}")
    shape = (resolution, factorisation.n_terms, factorisation.n_channels)
    texture = np.zeros((resolution, *shape), np.float32)
    samples = texel_centres(resolution * supersample)
    step = max(1, VALUES_A_PASS // (supersample * supersample * int(np.prod(shape))))
    for start in range(0, resolution, step):
        rows = samples[start * supersample : (start + step) * supersample]
        wo: F64 = hemi_octahedral_inverse(rows).astype(np.float64)
        phi = factorisation.eval_phi(wo.reshape(-1, 3))
        blocks = phi.reshape(-1, supersample, resolution, supersample, *shape[1:])
        texture[start : start + step] = blocks.mean(axis=(1, 3))
    return texture
