"""Oren and Nayar's rough diffuse surface: V-shaped cavities of Lambertian facets."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import above_horizon, clamped_cosines


@dataclass(frozen=True, eq=False)
class OrenNayar:
    """``albedo / pi (A + B max(0, cos dphi) sin a tan b)``, the qualitative model of [Oren1994]_.

    The qualitative model, not the full one: of dark facets the full one is negative where light and
    view graze the surface from opposite sides, and no BRDF may be.  What the qualitative one lacks
    is the light that bounces from facet to facet.

    Attributes
    ----------
    albedo
        Reflectance of the facets, in [0, 1].
    sigma
        Standard deviation of the facets' slope angle in radians, 0 (Lambert) to pi / 2.

    Notes
    -----
    With white facets the model creates up to 1.5 % of light at grazing incidence, most at sigma
    0.21: A + B / 2 exceeds 1 there.

    References
    ----------
    .. [Oren1994] M. Oren, S. K. Nayar, "Generalization of Lambert's Reflectance Model", 1994.
    """

    albedo: Float64[F64, " channels"]
    sigma: float

    @property
    def n_channels(self) -> int:
        """1 for grey, 3 for linear Rec.709."""
        return len(self.albedo)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        square = self.sigma * self.sigma
        level = 1.0 - 0.5 * square / (square + 0.33)
        slope = 0.45 * square / (square + 0.09)
        # cos dphi sin a tan b = sin_i sin_o cos dphi / max(cos_i, cos_o), without an angle
        planar = wi[..., 0] * wo[..., 0] + wi[..., 1] * wo[..., 1]
        ratio = np.maximum(planar, 0.0) / np.maximum(*clamped_cosines(wi, wo))
        shape = np.where(above_horizon(wi, wo), level + slope * ratio, 0.0)
        return self.albedo / np.pi * shape[..., None]
