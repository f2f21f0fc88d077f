"""Rotation of spherical-harmonic coefficients: two quarter turns between turns about the axis."""

from collections.abc import Sequence
from functools import lru_cache
from math import atan2, cos, pi, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from prtbake_storage.decode.sh import check_order, order_of
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.quarter_turn import quarter_turns

ROTATION_TOLERANCE = 1e-5
"""What the entries of R^T R - 1 may sum to: float32 leaves up to 1e-6."""

FEW_ROWS = 16
"""Below, calls cost more than products: degrees are multiplied together."""

WIDE_BAND = 128
"""Columns up to which degrees are joined then."""

Parts = NDArray[np.complex128]
"""Coefficients as c_m + i c_(-m), m = 0 to l for every degree l, along the last axis."""

Bands = list[tuple[slice, F64]]
"""Blocks of a matrix along its diagonal, with the columns that each acts on."""


def rotate_sh(
    coeffs: Float64[F64, "... coeffs"], rotation: Float64[F64, "... 3 3"]
) -> Float64[F64, "... coeffs"]:
    """Rotate functions given by their spherical-harmonic coefficients.

    Parameters
    ----------
    coeffs
        Coefficients of f, order^2 of them along the last axis.
    rotation
        R, proper and orthogonal; leading axes, where there are any, broadcast against those of
        the coefficients.

    Returns
    -------
    ndarray
        Coefficients of f(R^T d).

    Raises
    ------
    SettingsError
        R is a reflection or not orthogonal, or the number of coefficients is no square.

    Notes
    -----
    With R = Rz(a) Ry(b) Rz(c) and Q the turn by 90 degrees about y,

    ``R = Rz(a - 90) Q^T Rz(b) Q Rz(c + 90)``.

    A turn about z multiplies c_m + i c_(-m) by exp(i m angle), and Q is the same for every R.
    Where the matrices of J. Ivanic and K. Ruedenberg (J. Phys. Chem. 100, 1996, and its erratum)
    come from a recurrence over the degree for every R, here nothing but three angles depends on
    it: the error stays near rounding at every order and angle, poles included, and many vectors
    of a rotation each cost little more than two products with Q.
    """
    layout = _layout(order_of(coeffs.shape[-1]))
    first, middle, last = _phases(layout, rotation)
    parts = coeffs.take(layout.spread, axis=-1).view(np.complex128)
    parts = parts * first
    few = parts.size < FEW_ROWS * parts.shape[-1]
    parts = _turned(parts, layout.wide_bands if few else layout.bands)
    parts *= middle
    parts = _turned(parts, layout.wide_bands_back if few else layout.bands_back)
    parts *= last
    return parts.view(np.float64).take(layout.gather, axis=-1)


def sh_rotation_matrix(
    order: int, rotation: Float64[F64, "... 3 3"]
) -> Float64[F64, "... coeffs coeffs"]:
    """Give the orthogonal matrix D of a rotation: `rotate_sh` is c' = D c.

    Parameters
    ----------
    order
        n >= 1: D is n^2 x n^2, with a block for every degree.
    rotation
        R, proper and orthogonal.

    Returns
    -------
    ndarray
        D(R), with D(R S) = D(R) D(S).

    Raises
    ------
    SettingsError
        An order below 1; R is a reflection or not orthogonal.
    """
    check_order(order)
    columns = rotate_sh(np.eye(order * order), rotation[..., None, :, :])
    return np.swapaxes(columns, -1, -2)


def zyz_angles(rotation: list[float], number: int | None = None) -> tuple[float, float, float]:
    """Give a, b, c with R = Rz(a) Ry(b) Rz(c), to rounding for every R.

    Parameters
    ----------
    rotation
        R by rows, nine numbers.
    number
        Which of several it is, for an error's message.

    Returns
    -------
    tuple of float
        Radians.  Where b is 0 or pi, a and c are not unique; c is taken from what a leaves of R,
        so that the three fit together.

    Raises
    ------
    SettingsError
        R is a reflection or not orthogonal.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation
    defect = (
        abs(xx * xx + yx * yx + zx * zx - 1.0)
        + abs(xy * xy + yy * yy + zy * zy - 1.0)
        + abs(xz * xz + yz * yz + zz * zz - 1.0)
        + abs(xx * xy + yx * yy + zx * zy)
        + abs(xx * xz + yx * yz + zx * zz)
        + abs(xy * xz + yy * yz + zy * zz)
    )
    if not defect < ROTATION_TOLERANCE:
        name = _name(number)
        raise SettingsError(f"{name} is not orthogonal: R^T R differs from 1 by {defect:.3g}")
    determinant = xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx)
    if determinant < 0.0:
        name = _name(number)
        raise SettingsError(f"{name} is a reflection: its determinant is {determinant:.6g}, not 1")
    a = atan2(yz, xz)
    c, s = cos(a), sin(a)
    return a, atan2(c * xz + s * yz, zz), atan2(c * yx - s * xx, c * yy - s * xy)


def _name(number: int | None) -> str:
    return "the rotation" if number is None else f"rotation {number}"


class _Layout(NamedTuple):
    """Complex parts c_m + i c_(-m), m = 0 to l, of every degree, and the turn Q on them.

    Attributes
    ----------
    powers
        i m for every m below the order.
    orders
        m of every part.
    spread
        For the real and imaginary side of every part the coefficient it comes from; the imaginary
        side of m = 0 repeats the real one, and Q takes it no further.
    gather
        For every coefficient the side of a part that it is.
    bands, bands_back
        Slices of the sides with Q^T or Q: what takes a row to the turned one, and back.
    wide_bands, wide_bands_back
        The same with neighbouring degrees joined.
    """

    powers: NDArray[np.complex128]
    orders: NDArray[np.intp]
    spread: NDArray[np.intp]
    gather: NDArray[np.intp]
    bands: Bands
    bands_back: Bands
    wide_bands: Bands
    wide_bands_back: Bands


@lru_cache(maxsize=4)
def _layout(order: int) -> _Layout:
    degrees = np.repeat(np.arange(order), np.arange(order) + 1)
    orders = np.arange(len(degrees)) - degrees * (degrees + 1) // 2
    centres = degrees * (degrees + 1)
    spread = np.stack([centres + orders, centres - orders], axis=1).ravel()
    gather = np.empty(order * order, dtype=np.intp)
    gather[spread[1::2]] = np.arange(1, len(spread), 2)
    gather[spread[0::2]] = np.arange(0, len(spread), 2)
    turns = quarter_turns(order)
    transposed = [turn.T for turn in turns]
    return _Layout(
        powers=np.asarray(1j * np.arange(order), dtype=np.complex128),
        orders=orders,
        spread=spread,
        gather=gather,
        bands=_bands(transposed, 1),
        bands_back=_bands(turns, 1),
        wide_bands=_bands(transposed, WIDE_BAND),
        wide_bands_back=_bands(turns, WIDE_BAND),
    )


def _bands(blocks: Sequence[F64], width: int) -> Bands:
    """Join blocks along a diagonal until each is ``width`` wide."""
    bands: Bands = []
    joined: list[F64] = []
    start = stop = 0
    for block in blocks:
        joined.append(block)
        stop += len(block)
        if stop - start >= width or block is blocks[-1]:
            bands.append((slice(start, stop), block_diag(*joined)))
            joined, start = [], stop
    return bands


def _turned(parts: Parts, bands: Bands) -> Parts:
    flat = parts.view(np.float64)
    if len(bands) == 1:
        return (flat @ bands[0][1]).view(np.complex128)
    rows = flat.reshape(-1, flat.shape[-1])
    turned = np.empty_like(rows)
    for band, matrix in bands:
        np.matmul(rows[:, band], matrix, out=turned[:, band])
    return turned.view(np.complex128).reshape(parts.shape)


def _phases(layout: _Layout, rotation: Float64[F64, "... 3 3"]) -> Parts:
    """Give exp(i m angle) of the three turns, in the order they are done, for every part."""
    if rotation.shape[-2:] != (3, 3):
        raise SettingsError(f"a rotation is a 3 x 3 matrix, got the shape {rotation.shape}")
    rows = rotation.reshape(-1, 9).tolist()
    angles = [zyz_angles(row, i if len(rows) > 1 else None) for i, row in enumerate(rows)]
    turns = np.array([(c + 0.5 * pi, b, a - 0.5 * pi) for a, b, c in angles]).reshape(-1, 3)
    phases = np.exp(turns.T[:, :, None] * layout.powers).take(layout.orders, axis=2)
    return phases.reshape(3, *rotation.shape[:-2], len(layout.orders))
