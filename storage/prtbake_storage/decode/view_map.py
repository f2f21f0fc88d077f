"""The map that view textures are stored on: the upper hemisphere as a square.

The hemi-octahedral map sends a direction (x, y, z), z >= 0, to

    p = (x, y) / (|x| + |y| + z),   u = (p_x + p_y + 1) / 2,   v = (p_x - p_y + 1) / 2,

so the pole lies in the middle of the square and the horizon on its border.  Texel (row j, column
i) of a square of ``res`` texels is centred on u = (i + 0.5) / res, v = (j + 0.5) / res.
"""

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

TINY = 1e-20
"""Keeps the straight-down direction, which maps to the pole, from dividing by zero."""


def hemi_octahedral(directions: NDArray[np.floating]) -> NDArray[np.floating]:
    """Map local directions (..., 3) to (..., 2) in [0, 1]; those below the horizon go onto it."""
    x, y = directions[..., 0], directions[..., 1]
    z = np.maximum(directions[..., 2], 0.0)
    norm = np.maximum(np.abs(x) + np.abs(y) + z, TINY)
    p_x, p_y = x / norm, y / norm
    return np.stack([(p_x + p_y + 1.0) * 0.5, (p_x - p_y + 1.0) * 0.5], axis=-1)


def hemi_octahedral_inverse(uv: NDArray[np.floating]) -> NDArray[np.floating]:
    """Map (..., 2) in [0, 1] to unit local directions (..., 3) of the upper hemisphere."""
    a, b = 2.0 * uv[..., 0] - 1.0, 2.0 * uv[..., 1] - 1.0
    x, y = 0.5 * (a + b), 0.5 * (a - b)
    z = np.maximum(1.0 - np.abs(x) - np.abs(y), 0.0)
    direction: NDArray[np.floating] = np.stack([x, y, z], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return direction


def texel_centres(resolution: int) -> F64:
    """Return the (res, res, 2) map coordinates of the texel centres, row first."""
    at = (np.arange(resolution) + 0.5) / resolution
    u, v = np.meshgrid(at, at)
    return np.stack([u, v], axis=-1)


def lookup(texture: F32, uv: NDArray[np.floating]) -> F32:
    """Bilinear values of a (res, res, ...) texture at (n, 2) map coordinates, clamped to the edge.

    Returns (n, ...), float32.
    """
    height, width = texture.shape[:2]
    column, right = _cell(uv[:, 0], width)
    row, below = _cell(uv[:, 1], height)
    extra = (slice(None),) + (None,) * (texture.ndim - 2)
    right, below = right[extra], below[extra]
    next_row, next_column = np.minimum(row + 1, height - 1), np.minimum(column + 1, width - 1)
    upper = texture[row, column] * (1 - right) + texture[row, next_column] * right
    lower = texture[next_row, column] * (1 - right) + texture[next_row, next_column] * right
    value: F32 = upper * (1 - below) + lower * below
    return value


def _cell(at: NDArray[np.floating], size: int) -> tuple[NDArray[np.int64], F32]:
    """Texel to the left of a coordinate and how far beyond its centre the coordinate lies."""
    place = np.clip(at * size - 0.5, 0.0, size - 1.0)
    left = np.floor(place).astype(np.int64)
    return left, (place - left).astype(np.float32)
