"""Environments on Gaussian SRBFs of one bandwidth at the points of an icosphere."""

from dataclasses import replace

import numpy as np

from prtbake_storage.decode.light import LightFit
from prtbake_storage.decode.srbf import gram_matrix
from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.fit.objective import Lobes, evaluate_lobes, solve_coefficients
from prtbake_workers.environment.light_error import squared_error_ratio
from prtbake_workers.environment.subdivision import fine_texels
from prtbake_workers.geometry.icosphere import icosphere

CENTRE_COUNTS = (12, 42, 162, 642, 2562)
_ROWS_AT_A_TIME = 1 << 13


def fit_uniform_srbf(texels: Cells, n_centres: int, bandwidth: float | None = None) -> LightFit:
    """Fit the coefficients of SRBFs on fixed centres, regularised least squares in radiance.

    Solves (G + ridge) c = b with the exact Gram matrix G of the functions and b their integrals
    with the light: [Tsai2006]_ eq. (13) for light in place of transfer.  The ridge is that of the
    scattered fit and keeps any bandwidth solvable; it moves the error in the sixth digit.

    Parameters
    ----------
    texels
        Samples that resolve the functions (`uniform_samples`).
    n_centres
        12, 42, 162, 642 or 2562 points of an icosphere.
    bandwidth
        Of all functions, > 0; None is 60 for 642 centres and in proportion for others.

    Returns
    -------
    LightFit
        Of method ``srbf_uniform``, with its squared-error ratio on the samples.

    Raises
    ------
    SettingsError
        Another number of centres, or a bandwidth that is not positive.
    """
    lam = chosen_bandwidth(n_centres, bandwidth)
    centres = icosphere(CENTRE_COUNTS.index(n_centres))
    lobes = Lobes(centres, np.full(n_centres, lam))
    moments = np.zeros((n_centres, 3))
    for start in range(0, len(texels.solid_angles), _ROWS_AT_A_TIME):
        rows = slice(start, start + _ROWS_AT_A_TIME)
        flux = texels.radiance[rows] * texels.solid_angles[rows, None]
        moments += evaluate_lobes(lobes, texels.directions[rows]).T @ flux
    light = LightFit(
        centres=centres,
        bandwidths=lobes.bandwidths,
        coefficients=solve_coefficients(gram_matrix(centres, lam), moments, lobes.bandwidths),
        method="srbf_uniform",
    )
    return replace(light, error=squared_error_ratio(light, texels))


def chosen_bandwidth(n_centres: int, bandwidth: float | None) -> float:
    """Settle the bandwidth, or refuse it."""
    if n_centres not in CENTRE_COUNTS:
        raise SettingsError(
            f"n_centres is {n_centres}: one of {CENTRE_COUNTS}", pointer="/settings/n_centres"
        )
    lam = default_bandwidth(n_centres) if bandwidth is None else bandwidth
    if not (np.isfinite(lam) and lam > 0.0):
        raise SettingsError(f"bandwidth is {lam}: a positive number", pointer="/settings/bandwidth")
    return lam


def uniform_samples(environment: Environment, n_centres: int, bandwidth: float | None) -> Cells:
    """Cut the texels of a map to a quarter of the functions' width."""
    spacing = 0.25 / np.sqrt(chosen_bandwidth(n_centres, bandwidth))
    return fine_texels(environment, float(spacing))
