"""Spherical harmonics on the upper hemisphere: Gram matrix, and the error of projections.

Over z >= 0 functions of different m stay orthogonal, so that all there is to know lies in one
matrix S_m for every |m|: the functions l = |m|, |m| + 1, ... at quadrature points, times the roots
of the weights.  S_m^T S_m is the block of the Gram matrix; working with S_m itself keeps the half
of the digits that forming the product of a nearly singular matrix would lose.
"""

import numpy as np

from prtbake_storage.decode.sh import check_order, eval_sh
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, I64, Float64, Int64

METHODS = ("zero", "odd", "even", "least_squares")


def hemisphere_gram(order: int) -> Float64[F64, "coeffs coeffs"]:
    """Integrate the products of spherical harmonics over the upper hemisphere.

    ``A_ik = integral over z >= 0 of y_i(s) y_k(s) ds``, [Sloan2003]_ 9.1.

    Parameters
    ----------
    order
        n >= 1: n^2 functions.

    Returns
    -------
    ndarray
        A, symmetric, singular values in (0, 1]; the quadrature is exact, so that the error is
        that of rounding.
    """
    check_order(order)
    gram = np.zeros((order * order, order * order))
    for m, samples in enumerate(hemisphere_factors(order)):
        block = samples.T @ samples
        for sign in {m, -m}:
            functions = functions_of(order, sign)
            gram[np.ix_(functions, functions)] = block
    return gram


def hemisphere_projection_error(
    order: int, method: str, *, projection_order: int | None = None
) -> tuple[float, float]:
    """Give the squared error over the hemisphere of a way to project hemispherical functions.

    The signals are all combinations of the functions below ``order`` whose squared integral over
    the whole sphere is 1, restricted to z >= 0.

    Parameters
    ----------
    order
        Order of the signals, >= 1.
    method
        How the signal is continued below the horizon before it is projected on the sphere:
        ``zero``; ``odd`` as -f(x, y, -z); ``even`` as f(x, y, -z); or not at all:
        ``least_squares`` fits the functions to it on the hemisphere alone.
    projection_order
        Order of the functions it is projected on.  None takes the smallest that offers as many
        non-zero coefficients as the signal has, order^2: of n^2 functions n (n - 1) / 2 are odd in
        z and n (n + 1) / 2 even; the other two methods use them all.

    Returns
    -------
    tuple of float
        Largest and mean squared error, the extreme and mean eigenvalue of Q in ``E = c^T Q c``.

    Raises
    ------
    SettingsError
        An order below 1 or an unknown method.

    Notes
    -----
    [Sloan2003]_ 9.2 gives y(x, y, z) = y(x, y, -z) as its "odd" functions; read the two parities
    the other way round.  y_lm is even where l + m is.
    """
    check_order(order)
    if method not in METHODS:
        raise SettingsError(f"method is one of {', '.join(METHODS)}, got {method!r}")
    projection = _comparable_order(order, method) if projection_order is None else projection_order
    check_order(projection)
    largest = total = 0.0
    for m, samples in enumerate(hemisphere_factors(max(order, projection))):
        signals, functions = samples[:, : max(order - m, 0)], samples[:, : max(projection - m, 0)]
        if method == "least_squares":
            basis = column_space(functions)
            missed = signals - basis @ (basis.T @ signals)
        else:
            scale = _reflection_scale(method, functions.shape[1])
            missed = signals - functions @ (scale[:, None] * (functions.T @ signals))
        if signals.shape[1]:
            largest = max(largest, float(np.linalg.norm(missed, 2)) ** 2)
        total += (1 if m == 0 else 2) * float(np.sum(missed**2))
    return largest, total / order**2


def hemisphere_factors(order: int) -> list[Float64[F64, "points degrees"]]:
    """Give S_m for m = 0 ... order - 1: the block of m and of -m in the Gram matrix is S^T S.

    Gauss-Legendre points in z on [0, 1]: the products are polynomials of degree <= 2 order - 2,
    for which ``order`` points are exact.
    """
    points, weights = np.polynomial.legendre.leggauss(order)
    z = 0.5 * (points + 1.0)
    meridian = np.stack([np.sqrt(1.0 - z * z), np.zeros_like(z), z], axis=1)
    # on the meridian y = 0 the cosine of m phi is 1; its square over the circle is 2 pi or pi
    values = eval_sh(order, meridian) * np.sqrt(0.5 * np.pi * weights)[:, None]
    values[:, functions_of(order, 0)] *= np.sqrt(2.0)
    return [values[:, functions_of(order, m)] for m in range(order)]


def functions_of(order: int, m: int) -> Int64[I64, " degrees"]:
    """Give the indices of the functions of azimuthal order m, by rising degree."""
    degrees = np.arange(abs(m), order, dtype=np.int64)
    return degrees * (degrees + 1) + m


def column_space(matrix: Float64[F64, "points degrees"]) -> Float64[F64, "points rank"]:
    """Give an orthonormal basis of the columns' span, to working precision."""
    if not matrix.size:
        return matrix
    left, values, _ = np.linalg.svd(matrix, full_matrices=False)
    return left[:, values > values[0] * len(matrix) * np.finfo(np.float64).eps]


def _comparable_order(order: int, method: str) -> int:
    projection, short = order, {"odd": -1, "even": 1}.get(method)
    if short is None:
        return order
    while projection * (projection + short) // 2 < order**2:
        projection += 1
    return projection


def _reflection_scale(method: str, n_degrees: int) -> Float64[F64, " degrees"]:
    """Give what the integral over the hemisphere is multiplied by, for l = |m|, |m| + 1, ..."""
    if method == "zero":
        return np.ones(n_degrees)
    even = (np.arange(n_degrees) % 2 == 0) == (method == "even")
    return np.where(even, 2.0, 0.0)
