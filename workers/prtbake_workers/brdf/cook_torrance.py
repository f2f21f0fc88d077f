"""Cook and Torrance's microfacets: Beckmann's distribution in V-shaped cavities."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import (
    COSINE_FLOOR,
    above_horizon,
    clamped_cosines,
    diffuse_plus_lobe,
    half_vector,
    schlick,
    v_cavities,
)


def beckmann(
    cos_h: Float64[F64, "..."], sin2_h: Float64[F64, "..."], m: float
) -> Float64[F64, "..."]:
    """Beckmann's facet density ``exp(-tan^2 / m^2) / (pi m^2 cos^4)``, in 1/sr.

    Its integral against ``cos_h`` over the hemisphere is 1.
    """
    # below the floor the exponential is 0 for every m up to 2, so only 0 / 0 is avoided
    cos2 = np.maximum(cos_h, COSINE_FLOOR) ** 2
    density: F64 = np.exp(-sin2_h / (cos2 * m * m)) / (np.pi * m * m * cos2 * cos2)
    return density


@dataclass(frozen=True, eq=False)
class CookTorrance:
    """``kd / pi + ks F D G / (4 cos_i cos_o)``.

    F is Schlick's term, D Beckmann's density with 1 / (pi m^2 cos^4), and
    ``G = min(1, 2 (n.h) cos_o / (wo.h), 2 (n.h) cos_i / (wo.h))``.  Several conventions are in use:
    this one (4, not pi, in the denominator; pi in D; F kept) gives the published spectra that
    docs/theory quotes, and no other does.

    Attributes
    ----------
    kd, ks
        Diffuse and specular reflectance, in [0, 1].
    m
        Root mean square slope of the facets; 0.01 to 2.
    f0
        Fresnel reflectance at normal incidence, in [0, 1].

    Notes
    -----
    The value is unbounded where light and view graze the surface from opposite sides; it is held
    constant where a cosine falls below `base.COSINE_FLOOR`.
    """

    kd: Float64[F64, " channels"]
    ks: Float64[F64, " channels"]
    m: float
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
        facets = beckmann(half.cos_h, half.sin2_h, self.m) * v_cavities(half, cos_i, cos_o)
        lobe = facets / (4.0 * cos_i * cos_o)
        specular = self.ks * schlick(self.f0, half.cos_d) * lobe[..., None]
        return diffuse_plus_lobe(self.kd, specular, above_horizon(wi, wo))
