"""How far a measured BRDF is from the mirror symmetries that its factorisation needs."""

from dataclasses import dataclass

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import OrientedBrdf
from prtbake_workers.brdf.distance import brdf_distance

MOST_ASYMMETRY = 0.2
"""Relative L2 between a BRDF and its mirror image, of which averaging takes away half.  Ward with
slopes 0.1 and 0.4 comes to it where the grain lies 3.5 degrees askew, with 0.2 and 0.4 at 9."""

MIRRORS = {
    "tangent": np.array([1.0, -1.0, 1.0]),
    "bitangent": np.array([-1.0, 1.0, 1.0]),
}
"""About x and about y, by the axis that each leaves as it is."""


@dataclass(frozen=True, eq=False)
class Mirrored:
    """The mirror image of an anisotropic BRDF."""

    original: OrientedBrdf
    mirror: Float64[F64, "3"]

    @property
    def n_channels(self) -> int:
        """Those of the original."""
        return self.original.n_channels

    @property
    def is_isotropic(self) -> bool:
        """Whether the original is."""
        return self.original.is_isotropic

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        return self.original.eval_brdf(wi * self.mirror, wo * self.mirror)


def check_mirrors(brdf: OrientedBrdf) -> float:
    """Measure how far a BRDF is from its mirror images about x and y: the larger distance.

    Raises
    ------
    BrdfError
        It is more than `MOST_ASYMMETRY`: the mean of the images would be another material.
    """
    found = {
        axis: brdf_distance(Mirrored(brdf, mirror), brdf).relative_l2
        for axis, mirror in MIRRORS.items()
    }
    axis, worst = max(found.items(), key=lambda item: item[1])
    if worst > MOST_ASYMMETRY:
        raise BrdfError(
            f"the material is not mirror-symmetric about its {axis}: it differs from its mirror "
            f"image by {100 * worst:.0f} % (relative L2, at most {100 * MOST_ASYMMETRY:.0f} %), as "
            "where the grain lies askew in the measurement; anisotropic BRDFs need both mirrors"
        )
    return worst
