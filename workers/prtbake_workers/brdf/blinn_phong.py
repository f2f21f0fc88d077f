"""Blinn's lobe about the half vector, normalised."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import above_horizon, diffuse_plus_lobe, half_vector


@dataclass(frozen=True, eq=False)
class BlinnPhong:
    """``kd / pi + ks (n + 2)(n + 4) / (8 pi (2^(-n/2) + n)) (n . h)^n``.

    The factor is the exact one: at normal view the lobe reflects ``ks`` of a uniform environment
    (the familiar (n + 8) / (8 pi) is its limit for sharp lobes).

    Attributes
    ----------
    kd, ks
        Diffuse and specular reflectance, in [0, 1].
    exponent
        n of the formula, at least 1.
    """

    kd: Float64[F64, " channels"]
    ks: Float64[F64, " channels"]
    exponent: float

    @property
    def n_channels(self) -> int:
        """1 for grey, 3 for linear Rec.709."""
        return len(self.kd)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        n = self.exponent
        scale = (n + 2.0) * (n + 4.0) / (8.0 * np.pi * (2.0 ** (-0.5 * n) + n))
        lobe = scale * np.clip(half_vector(wi, wo).cos_h, 0.0, 1.0) ** n
        return diffuse_plus_lobe(self.kd, self.ks * lobe[..., None], above_horizon(wi, wo))
