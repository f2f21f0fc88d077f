"""Phong's lobe about the mirror direction, normalised."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import above_horizon, diffuse_plus_lobe


@dataclass(frozen=True, eq=False)
class Phong:
    """``kd / pi + ks (n + 2) / (2 pi) max(0, wo . r)^n`` with r the mirror image of ``wi``.

    At normal view the lobe reflects exactly ``ks`` of a uniform environment, and less elsewhere,
    because part of it dips below the horizon.

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
        # r = (-x, -y, z), so that wo . r is symmetric in the two directions
        cos_r = wi[..., 2] * wo[..., 2] - wi[..., 0] * wo[..., 0] - wi[..., 1] * wo[..., 1]
        lobe = (n + 2.0) / (2.0 * np.pi) * np.clip(cos_r, 0.0, 1.0) ** n
        return diffuse_plus_lobe(self.kd, self.ks * lobe[..., None], above_horizon(wi, wo))
