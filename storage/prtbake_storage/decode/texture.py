"""Albedo textures: linear values, bilinear, repeated outside the unit square."""

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


def lookup_repeating(texture: F32, uv: NDArray[np.floating]) -> F32:
    """Bilinear values of a (height, width, channels) texture at (n, 2) coordinates.

    The origin of ``uv`` is the lower left corner, that of the rows the upper left; texel centres
    lie at (i + 0.5) / size.  Returns (n, channels).
    """
    height, width = texture.shape[:2]
    left, right, across = _cell(uv[:, 0], width)
    upper, lower, down = _cell(1.0 - uv[:, 1], height)
    top = texture[upper, left] * (1 - across) + texture[upper, right] * across
    bottom = texture[lower, left] * (1 - across) + texture[lower, right] * across
    return np.asarray(top * (1 - down) + bottom * down, dtype=np.float32)


def _cell(at: NDArray[np.floating], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64], F32]:
    """Two neighbouring texels, wrapped, and how far beyond the first's centre the place lies."""
    place = (at - np.floor(at)) * size - 0.5
    first = np.floor(place)
    index = first.astype(np.int64)
    share = (place - first).astype(np.float32)[:, None]
    return index % size, (index + 1) % size, share


def srgb_to_linear(encoded: NDArray[np.floating]) -> F32:
    """Decode sRGB values in [0, 1] to linear light (IEC 61966-2-1)."""
    x = np.asarray(encoded, dtype=np.float64)
    linear = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    return linear.astype(np.float32)


def linear_to_srgb(linear: NDArray[np.floating]) -> F32:
    """Encode linear light in [0, 1] as sRGB (IEC 61966-2-1); values outside are clipped."""
    x = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return encoded.astype(np.float32)
