"""A fitted or measured BRDF made reciprocal and mirror-symmetric."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import Brdf, clamped_cosines, is_isotropic

MIRROR = np.array([1.0, -1.0, 1.0])
"""Reflection in the plane of x and z; of an isotropic BRDF any plane through the normal does."""


@dataclass(frozen=True, eq=False)
class Symmetrised:
    """Mean of a BRDF over its mirror image and over the exchange of its directions.

    Networks and tensor files keep neither symmetry exactly, while transfer is factorised for BRDFs
    that have both.  The two orders of light and view weigh as the cosine of their view, which makes
    the mean the closest BRDF with both symmetries in the norm of reflected light, and keeps it
    finite where a file states rho cos_o and rho itself divides by a small cosine.

    Attributes
    ----------
    original
        Isotropic.
    """

    original: Brdf

    @property
    def n_channels(self) -> int:
        """Those of the original."""
        return self.original.n_channels

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        both = self._weighted(wi, wo) + self._weighted(wi * MIRROR, wo * MIRROR)
        cos_i, cos_o = clamped_cosines(wi, wo)
        mean: F64 = 0.5 * both / (cos_i + cos_o)[..., None]
        return mean

    def _weighted(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Both orders; exchanging wi and wo does not even change the rounding."""
        cos_i, cos_o = (cosine[..., None] for cosine in clamped_cosines(wi, wo))
        given = cos_o * self.original.eval_brdf(wi, wo)
        return given + cos_i * self.original.eval_brdf(wo, wi)


MIRROR_IMAGES = (
    np.array([1.0, 1.0, 1.0]),
    np.array([-1.0, 1.0, 1.0]),
    np.array([1.0, -1.0, 1.0]),
    np.array([-1.0, -1.0, 1.0]),
)
"""The identity, both mirrors of a surface with a grain along x or y, and half a turn."""


@dataclass(frozen=True, eq=False)
class SymmetrisedOriented(Symmetrised):
    """Mean of an anisotropic BRDF over its mirror images about x and y, and over the exchange.

    Attributes
    ----------
    original
        Of any symmetry.
    images
        Of `MIRROR_IMAGES` that are averaged: all, or the first two where half a turn changes
        nothing, or the first alone where no mirror does.
    """

    images: int = len(MIRROR_IMAGES)

    @property
    def is_isotropic(self) -> bool:
        """Whether the original is."""
        return is_isotropic(self.original)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        sums = [self._weighted(wi * image, wo * image) for image in MIRROR_IMAGES[: self.images]]
        # pair by pair, which a mirror exchanges: not even the rounding changes
        while len(sums) > 1:
            sums = [first + second for first, second in zip(sums[::2], sums[1::2], strict=True)]
        cos_i, cos_o = clamped_cosines(wi, wo)
        return np.asarray(sums[0] / self.images / (cos_i + cos_o)[..., None])
