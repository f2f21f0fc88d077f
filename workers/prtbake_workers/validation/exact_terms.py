"""The separable terms without the tables that they are stored in, fast enough for every sample."""

from collections.abc import Callable

import numpy as np
from scipy.interpolate import CubicSpline

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.oriented_factorisation import OrientedFactorisation

EXACT_NODES = 2049
"""Cosine nodes of exact radial functions; cubic between them, so far finer than any table."""

EXACT_RINGS, EXACT_FINE = 129, 513
"""The same for functions of both angles: twice the rings of their stored tables, and half the step
of what is made of those, which divides the energy of a lookup's error by 16."""

Terms = Callable[[F64], F64]


class ExactTerms:
    """psi and phi of any factorisation from their defining sums (Nystroem), at many nodes."""

    def __init__(self, factorisation: Factorisation) -> None:
        self._psi, self._phi = _functions(factorisation)

    def eval_psi(self, wi: Float64[F64, "n 3"]) -> Float64[F64, "n terms"]:
        """Light side, without cosine."""
        return self._psi(wi)[..., 0]

    def eval_phi(self, wo: Float64[F64, "n 3"]) -> Float64[F64, "n terms channels"]:
        """View side, without cosine."""
        return self._phi(wo)


def _functions(factorisation: Factorisation) -> tuple[Terms, Terms]:
    if isinstance(factorisation, OrientedFactorisation):
        psi, phi = factorisation.tables_of(EXACT_RINGS, EXACT_FINE)
        return psi.evaluate, phi.evaluate
    if isinstance(factorisation, AzimuthalFactorisation):
        return _azimuthal(factorisation, light_side=True), _azimuthal(
            factorisation, light_side=False
        )
    raise TypeError(f"no exact terms of {type(factorisation).__name__}")


def _azimuthal(own: AzimuthalFactorisation, *, light_side: bool) -> Terms:
    """Make radial functions over theta, times the waves of the azimuth."""
    theta = np.linspace(0.0, 0.5 * np.pi, EXACT_NODES)
    radial = CubicSpline(theta, own.radial_exact(np.cos(theta), light_side=light_side))

    def evaluate(directions: Float64[F64, "n 3"]) -> Float64[F64, "n terms columns"]:
        value = radial(np.arccos(np.clip(directions[:, 2], 0.0, 1.0)))[:, own.unit_of_term]
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        turn = np.cos(azimuth[:, None] * own.orders - own.parity * (0.5 * np.pi))
        return np.asarray(value * np.where(directions[:, 2:] > 0.0, turn, 0.0)[..., None])

    return evaluate
