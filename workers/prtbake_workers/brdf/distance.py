"""How far one BRDF is from another."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import Brdf, is_isotropic


@dataclass(frozen=True)
class BrdfDistance:
    """Distance to a reference, over all channels and a grid of pairs of directions.

    ``relative_l2`` is the norm of the difference over that of the reference, both weighted with
    cos_i cos_o as the factorisation is: highlights decide it.  ``median_ratio`` is the median of
    the values' ratio: highlights do not.
    """

    relative_l2: float
    median_ratio: float

    def to_dict(self) -> dict[str, Any]:
        """Give plain values."""
        return asdict(self)


def brdf_distance(
    brdf: Brdf,
    reference: Brdf,
    *,
    n_theta: int | None = None,
    n_phi: int | None = None,
    n_azimuths: int = 8,
) -> BrdfDistance:
    """Compare two BRDFs on rings uniform in cos theta and azimuths uniform in phi.

    32 rings and 128 azimuths of the view unless given; where one of the BRDFs is anisotropic 16 and
    64, from each of ``n_azimuths`` azimuths of the light.

    Raises
    ------
    BrdfError
        The reference alone is black.
    """
    oriented = not (is_isotropic(brdf) and is_isotropic(reference))
    n_theta, n_phi = n_theta or (16 if oriented else 32), n_phi or (64 if oriented else 128)
    lights = 2.0 * np.pi * (np.arange(n_azimuths) + 0.5) / n_azimuths if oriented else np.zeros(1)
    cosines = (np.arange(n_theta) + 0.5) / n_theta
    values, wanted = np.broadcast_arrays(
        *(
            np.stack([_values(each, cosines, n_phi, light) for light in lights])
            for each in (brdf, reference)
        )
    )
    weight = cosines[:, None, None, None] * cosines[:, None, None]
    norm = float(np.linalg.norm(wanted * weight))
    if norm == 0.0:
        if values.any():
            raise BrdfError("only black can be compared with a black BRDF")
        return BrdfDistance(relative_l2=0.0, median_ratio=1.0)
    positive = wanted > 0.0
    return BrdfDistance(
        relative_l2=float(np.linalg.norm((values - wanted) * weight)) / norm,
        median_ratio=float(np.median(values[positive] / wanted[positive])),
    )


def _values(
    brdf: Brdf, cosines: Float64[F64, " theta"], n_phi: int, light: float
) -> Float64[F64, "theta theta phi channels"]:
    """Evaluate at every pair of rings and every difference of azimuths, at midpoints."""
    phi = light + 2.0 * np.pi * (np.arange(n_phi) + 0.5) / n_phi
    sines = np.sqrt(1.0 - cosines * cosines)
    wi = np.stack([sines * np.cos(light), sines * np.sin(light), cosines], axis=-1)[:, None, None]
    around = np.broadcast_arrays(
        sines[:, None] * np.cos(phi), sines[:, None] * np.sin(phi), cosines[:, None]
    )
    return brdf.eval_brdf(wi, np.stack(around, axis=-1))
