"""Legendre series of zonal kernels: product integrals of any two SRBFs, slowly but generally."""

import numpy as np
from scipy.special import eval_legendre, ive

from prtbake_workers.arrays import F64, Float64


def gaussian_legendre(lam: float, n_degrees: int) -> Float64[F64, " degrees"]:
    """Legendre coefficients of the Gaussian SRBF.

    ``G_l = (2 l + 1) exp(-lam) i_l(lam)``, i_l the modified spherical Bessel function.

    Parameters
    ----------
    lam
        Bandwidth, > 0.
    n_degrees
        Degrees 0 to n - 1; the series has converged at about 8 sqrt(lam) + 20.

    Returns
    -------
    ndarray
        G_l of [Tsai2006]_ eq. (1).
    """
    degrees = np.arange(n_degrees)
    return np.asarray((2 * degrees + 1) * np.sqrt(np.pi / (2.0 * lam)) * ive(degrees + 0.5, lam))


def abel_poisson_legendre(lam: float, n_degrees: int) -> Float64[F64, " degrees"]:
    """Legendre coefficients of the Abel-Poisson SRBF: ``G_l = (2 l + 1) lam^l``.

    Parameters
    ----------
    lam
        Bandwidth in (0, 1).
    n_degrees
        Degrees 0 to n - 1.

    Returns
    -------
    ndarray
        G_l of [Tsai2006]_ eq. (1).
    """
    degrees = np.arange(n_degrees)
    return np.asarray((2 * degrees + 1) * float(lam) ** degrees)


def legendre_product_integral(
    g: Float64[F64, " degrees"], h: Float64[F64, " degrees"], cos_angle: float
) -> float:
    """Integrate the product of two zonal kernels over the sphere, [Tsai2006]_ eq. (2).

    ``sum_l G_l H_l 4 pi / (2 l + 1) P_l(c)``

    Parameters
    ----------
    g, h
        Legendre coefficients of the kernels.
    cos_angle
        c, cosine of the angle between the centres.

    Returns
    -------
    float
        The integral in steradians; absolute error of rounding about 1e-16 of the value at c = 1.
    """
    degrees = np.arange(len(g))
    return float(
        np.sum(g * h * 4.0 * np.pi / (2 * degrees + 1) * eval_legendre(degrees, cos_angle))
    )
