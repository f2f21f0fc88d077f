"""A fitted or measured isotropic BRDF made reciprocal and mirror-symmetric."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import Brdf

MIRROR = np.array([1.0, -1.0, 1.0])
"""Reflection in the plane of x and z; of an isotropic BRDF any plane through the normal does."""


@dataclass(frozen=True, eq=False)
class Symmetrised:
    """Mean of a BRDF over the exchange of its directions and over its mirror image.

    Networks and tensor files keep neither symmetry exactly, while transfer is factorised for BRDFs
    that have both.  The mean is the closest BRDF with them in the L2 norm, and it creates no light
    where the original creates none.

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
        flipped_i, flipped_o = wi * MIRROR, wo * MIRROR
        # summed by pairs, so that exchanging wi and wo does not even change the rounding
        given = self.original.eval_brdf(wi, wo) + self.original.eval_brdf(wo, wi)
        mirrored = self.original.eval_brdf(flipped_i, flipped_o) + self.original.eval_brdf(
            flipped_o, flipped_i
        )
        return 0.25 * (given + mirrored)
