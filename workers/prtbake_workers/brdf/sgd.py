"""Shifted gamma distribution: a fit of MERL's materials."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import (
    COSINE_FLOOR,
    above_horizon,
    clamped_cosines,
    diffuse_plus_lobe,
    half_vector,
)

MAX_LOG_SLOPE = 6.0
"""Largest logarithm of the shadowing's exponent: exp(exp(6)) is 1e175, far beyond where G is 0."""

TINY = 1e-300
"""Stands for 0 in a logarithm."""


@dataclass(frozen=True, eq=False)
class Sgd:
    """``(rho_d + rho_s F D G(wi) G(wo) / (cos_i cos_o)) / pi`` [Bagher2012]_, channel by channel.

    With c = wi . h: ``F = f0 - c f1 + (1 - c)^5 (1 - f0)``, where negative 0; with
    ``x = alpha + tan^2 / alpha`` of the half vector ``D = kappa e^-x / (pi x^p cos^4)``;
    ``G(w) = 1 + lam (1 - exp(c max(0, theta - theta0)^k))`` within [0, 1].

    Attributes
    ----------
    rho_d, rho_s
        Diffuse and specular level, at least 0.
    alpha, p, kappa
        Width, tail and level of the facet distribution.
    f0, f1
        Of the Fresnel term; fitted, so that f0 may exceed 1.
    lam, c, k, theta0
        Of the shadowing; theta0 in radians.

    References
    ----------
    .. [Bagher2012] M. Bagher, C. Soler, N. Holzschuch, "Accurate Fitting of Measured Reflectances
       Using a Shifted Gamma Micro-Facet Distribution", 2012.
    """

    rho_d: Float64[F64, " channels"]
    rho_s: Float64[F64, " channels"]
    alpha: Float64[F64, " channels"]
    p: Float64[F64, " channels"]
    f0: Float64[F64, " channels"]
    f1: Float64[F64, " channels"]
    kappa: Float64[F64, " channels"]
    lam: Float64[F64, " channels"]
    c: Float64[F64, " channels"]
    k: Float64[F64, " channels"]
    theta0: Float64[F64, " channels"]

    @property
    def n_channels(self) -> int:
        """Three: linear Rec.709."""
        return len(self.rho_d)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        half = half_vector(wi, wo)
        cos_i, cos_o = clamped_cosines(wi, wo)
        cos_d = half.cos_d[..., None]
        fresnel = self.f0 - cos_d * self.f1 + (1.0 - cos_d) ** 5 * (1.0 - self.f0)
        shadowing = self._visible_share(wi[..., 2]) * self._visible_share(wo[..., 2])
        facets = self._facets(half.cos_h, half.sin2_h) / (cos_i * cos_o)[..., None]
        specular = self.rho_s * np.maximum(fresnel, 0.0) * facets * shadowing / np.pi
        return diffuse_plus_lobe(self.rho_d, specular, above_horizon(wi, wo))

    def _facets(
        self, cos_h: Float64[F64, "..."], sin2_h: Float64[F64, "..."]
    ) -> Float64[F64, "... channels"]:
        cos2 = np.maximum(cos_h, COSINE_FLOOR)[..., None] ** 2
        x = self.alpha + sin2_h[..., None] / (cos2 * self.alpha)
        density: F64 = self.kappa * np.exp(-x) / (np.pi * x**self.p * cos2 * cos2)
        return density

    def _visible_share(self, cosine: Float64[F64, "..."]) -> Float64[F64, "... channels"]:
        beyond = np.arccos(np.clip(cosine, 0.0, 1.0))[..., None] - self.theta0
        # in logarithms: the fits hold c up to 1e38 and k up to 700
        log_slope = np.log(np.maximum(self.c, TINY)) + self.k * np.log(np.maximum(beyond, TINY))
        slope = np.where(beyond > 0.0, np.exp(np.minimum(log_slope, MAX_LOG_SLOPE)), 0.0)
        share: F64 = np.clip(1.0 - self.lam * np.expm1(slope), 0.0, 1.0)
        return share
