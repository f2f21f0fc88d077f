"""Measured scattering coefficients of well-known materials [Jensen2001]_, figure 5."""

from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from prtbake_workers.arrays import F64, Float64


@dataclass(frozen=True, eq=False)
class ScatteringMedium:
    """What light meets inside a material.

    Attributes
    ----------
    scattering
        Reduced scattering coefficient sigma_s' of red, green and blue, per millimetre.
    absorption
        sigma_a, likewise.
    eta
        Index of refraction against air.
    """

    scattering: Float64[F64, "3"]
    absorption: Float64[F64, "3"]
    eta: float


def _medium(
    scattering: tuple[float, float, float],
    absorption: tuple[float, float, float],
    eta: float = 1.3,
) -> ScatteringMedium:
    return ScatteringMedium(np.array(scattering), np.array(absorption), eta)


MEASURED_MEDIA = MappingProxyType(
    {
        "apple": _medium((2.29, 2.39, 1.97), (0.0030, 0.0034, 0.046)),
        "chicken1": _medium((0.15, 0.21, 0.38), (0.015, 0.077, 0.19)),
        "chicken2": _medium((0.19, 0.25, 0.32), (0.018, 0.088, 0.20)),
        "cream": _medium((7.38, 5.47, 3.15), (0.0002, 0.0028, 0.0163)),
        "ketchup": _medium((0.18, 0.07, 0.03), (0.061, 0.97, 1.45)),
        "marble": _medium((2.19, 2.62, 3.00), (0.0021, 0.0041, 0.0071), 1.5),
        "potato": _medium((0.68, 0.70, 0.55), (0.0024, 0.0090, 0.12)),
        "skim_milk": _medium((0.70, 1.22, 1.90), (0.0014, 0.0025, 0.0142)),
        "skin1": _medium((0.74, 0.88, 1.01), (0.032, 0.17, 0.48)),
        "skin2": _medium((1.09, 1.59, 1.79), (0.013, 0.070, 0.145)),
        "spectralon": _medium((11.6, 20.4, 14.9), (0.0, 0.0, 0.0)),
        "whole_milk": _medium((2.55, 3.21, 3.77), (0.0011, 0.0024, 0.014)),
    }
)
"""By name; the index of refraction is 1.3 but for marble."""
