"""Lafortune's generalised cosine lobes."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import above_horizon, diffuse_plus_lobe


@dataclass(frozen=True, eq=False)
class Lobe:
    """``weight max(0, cx xi xo + cy yi yo + cz zi zo)^exponent``.

    Attributes
    ----------
    weight
        Factor of each channel in 1/sr, at least 0.
    factors
        cx, cy and cz.  (-1, -1, 1) is the mirror's lobe, (1, 1, 1) the retro-reflector's; |cz|
        above |cx| pulls the lobe to the normal, below it pushes the lobe to the horizon.
    exponent
        At least 0.
    """

    weight: Float64[F64, " channels"]
    factors: tuple[float, float, float]
    exponent: float

    def eval_lobe(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr."""
        cx, cy, cz = self.factors
        x, y, z = (wi[..., axis] * wo[..., axis] for axis in range(3))
        cosine = cx * x + cy * y + cz * z
        # with exponent 0 a lobe is still 0 on its dark side
        lobe = np.where(cosine > 0.0, np.maximum(cosine, 0.0) ** self.exponent, 0.0)
        return self.weight * lobe[..., None]


@dataclass(frozen=True, eq=False)
class Lafortune:
    """``kd / pi`` and a sum of lobes [Lafortune1997]_, reciprocal by its symmetry.

    Attributes
    ----------
    kd
        Diffuse reflectance, in [0, 1].
    lobes
        One or more; each with a weight of its own, which the paper folds into the factors.

    Notes
    -----
    Nothing normalises a lobe: whether the sum creates light is for `checks.check_energy` to say.

    References
    ----------
    .. [Lafortune1997] E. Lafortune, S.-C. Foo, K. Torrance, D. Greenberg, "Non-Linear Approximation
       of Reflectance Functions", 1997.
    """

    kd: Float64[F64, " channels"]
    lobes: tuple[Lobe, ...]

    @property
    def n_channels(self) -> int:
        """1 for grey, 3 for linear Rec.709."""
        return len(self.kd)

    @property
    def is_isotropic(self) -> bool:
        """Whether every lobe has cx = cy."""
        return all(lobe.factors[0] == lobe.factors[1] for lobe in self.lobes)

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        specular = self.lobes[0].eval_lobe(wi, wo)
        for lobe in self.lobes[1:]:
            specular = specular + lobe.eval_lobe(wi, wo)
        return diffuse_plus_lobe(self.kd, specular, above_horizon(wi, wo))
