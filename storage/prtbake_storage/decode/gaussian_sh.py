"""Spherical-harmonic coefficients of Gaussian SRBFs in closed form, in plain numpy.

A lobe ``G(w . xi) = exp(lam (w . xi - 1))`` has the Legendre series ``sum_l G_l P_l(w . xi)`` with
``G_l = (2 l + 1) exp(-lam) i_l(lam)``, [Tsai2006]_ eq. (1) and (4), i_l the modified spherical
Bessel function.  The addition theorem ``P_l(w . xi) = 4 pi / (2 l + 1) sum_m y_lm(w) y_lm(xi)``
then gives its coefficients,

    c_lm = 4 pi exp(-lam) i_l(lam) y_lm(xi).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from prtbake_storage.decode.sh import check_order, eval_sh

F64 = NDArray[np.float64]

CONVERGED_DEGREES = (8.0, 20)
"""Ratios are started at degree ``order + 8 sqrt(lam) + 20``: what is wrong with the first one has
shrunk by exp(-(8^2)) below the order."""


def scaled_bessel(order: int, lam: ArrayLike) -> F64:
    """Evaluate ``exp(-lam) i_l(lam)`` for the degrees below ``order``.

    Parameters
    ----------
    order
        n >= 1.
    lam
        (lobes,) bandwidths, > 0.

    Returns
    -------
    ndarray
        (n, lobes), between 0 and 1; underflows to 0.

    Notes
    -----
    ``i_l`` falls with l, so upward recurrence multiplies rounding.  Here the ratios
    ``r_l = i_(l+1) / i_l`` come from ``r_l = lam / (2 l + 3 + lam r_(l+1))`` downwards, in positive
    terms alone, and ``i_0`` is ``(1 - exp(-2 lam)) / (2 lam)`` scaled.
    Relative error about 1e-15 times the degree, for lam from 1e-6 to 1e6.
    """
    check_order(order)
    widths = np.asarray(lam, dtype=np.float64).reshape(-1)
    factor, constant = CONVERGED_DEGREES
    top = order + int(factor * np.sqrt(widths.max(initial=0.0))) + constant
    ratios = np.ones((order, len(widths)))
    ratio = np.zeros(len(widths))
    for degree in range(top, -1, -1):
        ratio = widths / (2 * degree + 3 + widths * ratio)
        if degree + 1 < order:
            ratios[degree + 1] = ratio
    ratios[0] = -np.expm1(-2.0 * widths) / (2.0 * widths)
    return np.asarray(np.cumprod(ratios, axis=0))


def gaussian_sh(order: int, centres: ArrayLike, lam: ArrayLike) -> F64:
    """Project Gaussian SRBFs on the spherical harmonics below ``order``, exactly.

    Parameters
    ----------
    order
        n >= 1.
    centres
        (lobes, 3) unit vectors, to the 1e-3 that files may be off; their length is divided out.
    lam
        (lobes,) bandwidths, > 0.

    Returns
    -------
    ndarray
        (n^2, lobes): column j holds the coefficients of lobe j.
    """
    axes = np.asarray(centres, dtype=np.float64)
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    degrees = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    return np.asarray(4.0 * np.pi * scaled_bessel(order, lam)[degrees] * eval_sh(order, axes).T)
