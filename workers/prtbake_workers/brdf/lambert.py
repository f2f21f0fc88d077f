"""Lambert's diffuse reflection."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import above_horizon


@dataclass(frozen=True, eq=False)
class Lambert:
    """``albedo / pi``.

    Attributes
    ----------
    albedo
        Share of the light that is reflected, in [0, 1].
    """

    albedo: Float64[F64, " channels"]

    @property
    def n_channels(self) -> int:
        """1 for grey, 3 for linear Rec.709."""
        return len(self.albedo)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        value: F64 = np.where(above_horizon(wi, wo)[..., None], self.albedo / np.pi, 0.0)
        return value
