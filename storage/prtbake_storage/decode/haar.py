"""Haar wavelets on the faces of a cube map, orthonormal over solid angle, in plain numpy.

Texels of a cube map differ in size.  The plain Haar transform is orthonormal in the norm of the
texels' numbers; in the norm of radiance a texel counts by its solid angle w.  So samples enter as
f sqrt(w), and two neighbours of areas w_1 and w_2 become

    low  =  p s_1 + q s_2,    high = -q s_1 + p s_2,    p^2 = w_1 / (w_1 + w_2),  q^2 = 1 - p^2 :

an unbalanced Haar step.  ``low`` is the mean over both times the root of their area, so that a
constant has one coefficient a face.  Columns are joined, then rows, then the low quarter again
(the non-standard decomposition), down to one mean a face.  The sum of products of coefficients is
the integral of the product of two functions.

Coefficients of a face lie in the usual pyramid: of a square of n x n its first n/2 rows and columns
are the next coarser level; flat index ``(face * N + row) * N + column``.
"""

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.cube_map import N_FACES, face_solid_angles

F64 = NDArray[np.float64]

MOST_RESOLUTION = 512
"""Texels along an edge of a light's cube map: 1.6 million of them."""

Turn = tuple[F64, F64]
"""p and q of every pair."""


def check_resolution(resolution: int) -> None:
    """Refuse with ValueError what no face can be halved from."""
    if not 1 <= resolution <= MOST_RESOLUTION or resolution & (resolution - 1):
        raise ValueError(f"resolution is {resolution}, not a power of two up to {MOST_RESOLUTION}")


def haar(radiance: F64, resolution: int) -> F64:
    """Transform a cube map.

    Parameters
    ----------
    radiance
        (6 N^2, channels) of the texels, constant over each.
    resolution
        N, a power of two.

    Returns
    -------
    ndarray
        (6 N^2, channels): integrals of the radiance with orthonormal wavelets.
    """
    check_resolution(resolution)
    shape = (N_FACES, resolution, resolution, -1)
    values = radiance.reshape(shape) * _root_areas(resolution)
    for n, across, down in _levels(resolution):
        block = values[:, :n, :n]
        joined = np.concatenate(_split(block.swapaxes(1, 2), across), axis=1).swapaxes(1, 2)
        halves = [
            np.concatenate(_split(half, down), axis=1) for half in np.split(joined, 2, axis=2)
        ]
        values[:, :n, :n] = np.concatenate(halves, axis=2)
    return np.asarray(values.reshape(radiance.shape))


def inverse_haar(coefficients: F64, resolution: int) -> F64:
    """Give the radiance (6 N^2, channels) of a cube map's coefficients: `haar` undone."""
    check_resolution(resolution)
    values = coefficients.reshape(N_FACES, resolution, resolution, -1).copy()
    for n, across, down in reversed(_levels(resolution)):
        block = values[:, :n, :n]
        columns = [_join(half, down) for half in np.split(block, 2, axis=2)]
        joined = np.concatenate(columns, axis=2).swapaxes(1, 2)
        values[:, :n, :n] = _join(joined, across).swapaxes(1, 2)
    return np.asarray((values / _root_areas(resolution)).reshape(coefficients.shape))


def _root_areas(resolution: int) -> F64:
    return np.asarray(np.sqrt(face_solid_angles(resolution))[:, :, None])


def _levels(resolution: int) -> list[tuple[int, Turn, Turn]]:
    """From fine to coarse: the edge n, turns of its pairs of columns, and then of rows.

    The first axis of a turn runs over the pairs.
    """
    areas = face_solid_angles(resolution)
    levels = []
    n = resolution
    while n > 1:
        across = _turn(areas[:, 0::2].T, areas[:, 1::2].T)
        pairs = areas[:, 0::2] + areas[:, 1::2]
        down = _turn(pairs[0::2], pairs[1::2])
        levels.append((n, across, down))
        areas = pairs[0::2] + pairs[1::2]
        n //= 2
    return levels


def _turn(first: F64, second: F64) -> Turn:
    whole = first + second
    return np.sqrt(first / whole)[:, :, None], np.sqrt(second / whole)[:, :, None]


def _split(values: F64, turn: Turn) -> tuple[F64, F64]:
    """Turn neighbours along the second axis into their mean and their difference."""
    p, q = turn
    first, second = values[:, 0::2], values[:, 1::2]
    return p * first + q * second, p * second - q * first


def _join(halves: F64, turn: Turn) -> F64:
    """Undo `_split` of means and differences one after the other along the second axis."""
    p, q = turn
    low, high = np.split(halves, 2, axis=1)
    values = np.empty_like(halves)
    values[:, 0::2] = p * low - q * high
    values[:, 1::2] = q * low + p * high
    return values
