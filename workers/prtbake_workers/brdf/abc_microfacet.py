"""The ABC microfacet model: a fit of MERL's materials."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import (
    LENGTH_FLOOR,
    above_horizon,
    clamped_cosines,
    diffuse_plus_lobe,
    half_vector,
    v_cavities,
)


def fresnel_dielectric(cos_d: Float64[F64, "..."], ior: float) -> Float64[F64, "..."]:
    """Reflectance of unpolarised light at a dielectric of index ``ior`` >= 1, from outside."""
    inside = np.sqrt(1.0 - (1.0 - cos_d * cos_d) / (ior * ior))
    across = (cos_d - ior * inside) / np.maximum(cos_d + ior * inside, LENGTH_FLOOR)
    along = (ior * cos_d - inside) / np.maximum(ior * cos_d + inside, LENGTH_FLOOR)
    reflectance: F64 = 0.5 * (across * across + along * along)
    return reflectance


@dataclass(frozen=True, eq=False)
class AbcMicrofacet:
    """``kd / pi + F D G / (pi cos_i cos_o)``, D = ``a / (1 + b (1 - cos_h))^c`` [Low2012]_.

    G is Cook and Torrance's, F that of a dielectric.

    Attributes
    ----------
    kd
        Diffuse reflectance.
    a
        Level of the facet distribution, a channel each.
    b, c
        Its width and its tail.
    ior
        Index of refraction, at least 1.

    References
    ----------
    .. [Low2012] J. Low, J. Kronander, A. Ynnerman, J. Unger, "BRDF Models for Accurate and
       Efficient Rendering of Glossy Surfaces", 2012.
    """

    kd: Float64[F64, " channels"]
    a: Float64[F64, " channels"]
    b: float
    c: float
    ior: float

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
        # 1 - cos_h without cancellation
        facets = (1.0 + self.b * half.sin2_h / (1.0 + half.cos_h)) ** -self.c
        lobe = facets * v_cavities(half, cos_i, cos_o) / (np.pi * cos_i * cos_o)
        lobe = lobe * fresnel_dielectric(half.cos_d, self.ior)
        return diffuse_plus_lobe(self.kd, self.a * lobe[..., None], above_horizon(wi, wo))
