"""Trowbridge and Reitz's microfacets (GGX) with Smith's masking and shadowing."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import (
    above_horizon,
    clamped_cosines,
    diffuse_plus_lobe,
    half_vector,
    schlick,
)


def trowbridge_reitz(
    cos_h: Float64[F64, "..."], sin2_h: Float64[F64, "..."], alpha: float
) -> Float64[F64, "..."]:
    """Facet density ``alpha^2 / (pi (alpha^2 cos^2 + sin^2)^2)``, in 1/sr.

    Its integral against ``cos_h`` over the hemisphere is 1.
    """
    a2 = alpha * alpha
    density: F64 = a2 / (np.pi * (a2 * cos_h * cos_h + sin2_h) ** 2)
    return density


def smith_g1(cos_theta: Float64[F64, "..."], alpha: float) -> Float64[F64, "..."]:
    """Smith's masking ``2 cos / (cos + sqrt(alpha^2 + (1 - alpha^2) cos^2))`` of one direction."""
    slope = np.sqrt(alpha * alpha + (1.0 - alpha * alpha) * cos_theta * cos_theta)
    masking: F64 = 2.0 * cos_theta / (cos_theta + slope)
    return masking


@dataclass(frozen=True, eq=False)
class Ggx:
    """``kd / pi + ks F D G2 / (4 cos_i cos_o)`` with height-correlated masking and shadowing G2.

    Attributes
    ----------
    kd, ks
        Diffuse and specular reflectance, in [0, 1].
    alpha
        Width of the facet distribution itself (not its square root); 0.01 to 1.
    f0
        Fresnel reflectance at normal incidence, in [0, 1].

    Notes
    -----
    Single scattering: rough surfaces lose the light that would bounce among the facets.
    """

    kd: Float64[F64, " channels"]
    ks: Float64[F64, " channels"]
    alpha: float
    f0: Float64[F64, " channels"]

    @property
    def n_channels(self) -> int:
        """1 for grey, 3 for linear Rec.709."""
        return len(self.kd)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        half = half_vector(wi, wo)
        cos_i, cos_o = clamped_cosines(wi, wo)
        a2 = self.alpha * self.alpha
        # G2 / (4 cos_i cos_o) in one piece: its numerator cancels both cosines
        slopes = cos_o * np.sqrt(a2 + (1.0 - a2) * cos_i * cos_i) + cos_i * np.sqrt(
            a2 + (1.0 - a2) * cos_o * cos_o
        )
        lobe = trowbridge_reitz(half.cos_h, half.sin2_h, self.alpha) * 0.5 / slopes
        specular = self.ks * schlick(self.f0, half.cos_d) * lobe[..., None]
        return diffuse_plus_lobe(self.kd, specular, above_horizon(wi, wo))
