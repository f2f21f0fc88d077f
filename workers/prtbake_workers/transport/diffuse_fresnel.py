"""Diffuse light at a smooth boundary between air and a denser material."""

import numpy as np

from prtbake_storage.errors import SettingsError

ETA_RANGE = (1.0, 2.5)
"""Where the polynomial below keeps within 0.0055 of the integral; beyond, it goes wrong."""

N_COSINES = 64
"""Gauss-Legendre nodes of the integral: 1e-9 down to eta = 1.0001, rounding from 1.1 on."""


def internal_reflectance(eta: float) -> float:
    """Give F_dr, the share of diffuse light from inside that the boundary turns back.

    The rational fit ``-1.440 / eta^2 + 0.710 / eta + 0.668 + 0.0636 eta`` of [Jensen2001]_: within
    1.7e-3 of the integral of Fresnel's equations for eta in [1, 2] (5e-4 from 1.1 on), 5.5e-3 at
    2.5.
    """
    check_eta(eta)
    return -1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta


def entering_transmittance(eta: float) -> float:
    """Give the share of diffuse light from outside that enters, by quadrature.

    ``2 integral of (1 - F(mu)) mu dmu`` over cosines in [0, 1] with Fresnel's F for unpolarised
    light.  It is not 1 - F_dr: by reciprocity (1 - F_dr) = transmittance / eta^2.
    """
    check_eta(eta)
    nodes, weights = np.polynomial.legendre.leggauss(N_COSINES)
    outside = 0.5 * (nodes + 1.0)
    inside = np.sqrt(1.0 - (1.0 - outside**2) / eta**2)
    across = (outside - eta * inside) / (outside + eta * inside)
    along = (eta * outside - inside) / (eta * outside + inside)
    reflected = 0.5 * (across**2 + along**2)
    return 1.0 - float((weights * outside) @ reflected)


def check_eta(eta: float) -> None:
    """Refuse an index of refraction outside `ETA_RANGE`."""
    low, high = ETA_RANGE
    if not low <= eta <= high:
        raise SettingsError(f"eta lies in [{low}, {high}], not {eta}")
