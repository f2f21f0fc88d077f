"""Real spherical harmonics: orthonormal, without the Condon-Shortley phase, index l (l + 1) + m."""

from functools import lru_cache
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError

F64 = NDArray[np.float64]

UNIT_TOLERANCE = 1e-6
"""What a direction's length may differ from 1: float32 gives 1e-7; more is no unit vector."""

MOST_ORDER = 100
"""Of a basis that transfer is projected on: 10,000 functions, evaluated to 1e-13."""

CACHED_VALUES = 8192
"""Values of one degree evaluated at once: what a pass works on stays in the cache."""


def eval_sh(order: int, directions: F64) -> F64:
    """Evaluate the real spherical harmonics of the degrees below ``order``.

    ``y_lm = N_lm P_l^|m|(z) (sqrt(2) cos m phi | 1 | sqrt(2) sin |m| phi)`` for m > 0, = 0, < 0,
    with P_l^m free of the factor (-1)^m: l = 1 is sqrt(3 / (4 pi)) times y, z, x.

    Parameters
    ----------
    order
        n >= 1: n^2 functions, degrees 0 to n - 1.
    directions
        (dirs, 3) unit vectors; in a local frame z is the normal.

    Returns
    -------
    ndarray
        (dirs, order^2); column l (l + 1) + m holds y_lm.  The columns are contiguous, not the rows.

    Raises
    ------
    SettingsError
        An order below 1, or a direction that is no unit vector; names its row.

    Notes
    -----
    ``P_l^m(z) / sin^m`` is a polynomial in z, ``sin^m exp(i m phi) = (x + i y)^m`` one in x and y:
    no pole is special and no angle is taken.  The first comes from the recurrence of the
    normalised functions over the degree at fixed m, which is stable on the whole sphere; its
    values reach 1e20 at order 100 where sin^m is as small.  The absolute error there is about
    1e-13, at the poles 3e-12, where a rounding of z counts l^2 / 2 times.
    """
    unit = _unit(order, directions)
    values = np.empty((order * order, len(unit)))
    step = max(1, CACHED_VALUES // order)
    for start in range(0, len(unit), step):
        block = slice(start, start + step)
        _evaluate(order, unit[block].T, values[:, block])
    return values.T


def _evaluate(order: int, unit: F64, values: F64) -> None:
    """Fill ``values`` (coeffs, dirs) from the components (3, dirs) of unit vectors."""
    x, y, z = unit
    cosines, sines = _sectors(order, x, y)
    now, before = np.zeros((2, order, len(z)))
    rest = np.empty_like(now)
    for degree, (first, a, b) in enumerate(_recurrence(order)):
        # row m holds P_lm / sin^m: the diagonal is a constant, the rest follows from two degrees
        new = before[:degree]
        new *= b
        np.multiply(now[:degree], z, out=rest[:degree])
        np.subtract(rest[:degree], new, out=new)
        new *= a
        before[degree] = first
        now, before = before, now
        centre = degree * (degree + 1)
        zonal, diagonal = slice(centre, centre + degree + 1), slice(1, degree + 1)
        np.multiply(now[: degree + 1], cosines[: degree + 1], out=values[zonal])
        np.multiply(now[diagonal], sines[diagonal], out=values[degree * degree : centre][::-1])


def check_order(order: int) -> None:
    """Refuse an order below 1."""
    if order < 1:
        raise SettingsError(f"the order of spherical harmonics is at least 1, got {order}")


def order_of(n_coeffs: int) -> int:
    """Give the order that has ``n_coeffs`` functions, or refuse a number that is no square."""
    order = isqrt(n_coeffs)
    if order < 1 or order * order != n_coeffs:
        raise SettingsError(
            f"{n_coeffs} coefficients are no complete set of spherical harmonics: "
            f"order n has n^2, for example {max(order, 1) ** 2}"
        )
    return order


def _unit(order: int, directions: F64) -> F64:
    check_order(order)
    norms = np.sqrt(np.einsum("ij,ij->i", directions, directions))
    near = np.abs(norms - 1.0) < UNIT_TOLERANCE
    if not near.all():  # a NaN is not near
        row = int(np.argmin(near))
        raise SettingsError(f"direction {row} is no unit vector: length {norms[row]}")
    return np.asarray(directions / norms[:, None])


def _sectors(order: int, x: F64, y: F64) -> F64:
    """Give sqrt(2) Re and Im of (x + i y)^m; 1 and 0 for m = 0."""
    powers = np.empty((order, len(x)), dtype=np.complex128)
    powers[0] = np.sqrt(2.0)
    powers[1:] = x + 1j * y
    np.multiply.accumulate(powers, axis=0, out=powers)
    sectors = np.stack([powers.real, powers.imag])
    sectors[0, 0] = 1.0
    return sectors


@lru_cache(maxsize=8)
def _recurrence(order: int) -> list[tuple[float, F64, F64]]:
    """Give for every degree l: P_ll / sin^l, and a, b of P_lm = a (z P_(l-1)m - b P_(l-2)m)."""
    levels = []
    first = np.sqrt(0.25 / np.pi)
    for degree in range(order):
        if degree:
            first *= np.sqrt((2 * degree + 1) / (2 * degree))
        m = np.arange(degree, dtype=np.float64)[:, None]
        a = np.sqrt((4.0 * degree**2 - 1.0) / (degree**2 - m**2))
        squares = np.maximum((degree - 1.0) ** 2 - m**2, 0.0)
        b = np.sqrt(squares / np.maximum(4.0 * (degree - 1.0) ** 2 - 1.0, 1.0))
        levels.append((float(first), a, b))
    return levels
