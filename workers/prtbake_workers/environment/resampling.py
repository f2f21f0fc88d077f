"""Change of sampling: box filter of lat-long maps and resampling of any lookup, keeping energy."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64

Lookup = Callable[[F64], F64]
"""Radiance (dirs, 3) of unit directions (dirs, 3)."""

_SAMPLES_AT_A_TIME = 1 << 19
"""Directions looked up at once: 12 MB of them."""


def node_edges(size: int) -> Float64[F64, " edges"]:
    """Give the edges in [0, 1] of cells whose centres span it, as OpenEXR places its samples."""
    if size == 1:
        return np.array([0.0, 1.0])
    return np.clip((np.arange(size + 1) - 0.5) / (size - 1), 0.0, 1.0)


def box_filter(
    radiance: Float32[F32, "height width 3"], height: int, width: int, *, nodes: bool = False
) -> Float32[F32, "rows columns 3"]:
    """Average a lat-long map over the texels of another, weighted by the exact solid angle.

    The texels of both maps are rectangles in azimuth and cos(theta), so the overlap is a product
    of two one-dimensional overlaps, and the integral over the sphere is kept to rounding.  With
    ``nodes`` the source's outer pixel centres lie on the edges of the map (``node_edges``).
    """
    sources = node_edges if nodes else _cell_edges
    rows = _overlap(
        -np.cos(sources(radiance.shape[0]) * np.pi), -np.cos(_cell_edges(height) * np.pi)
    )
    columns = _overlap(sources(radiance.shape[1]), _cell_edges(width))
    halfway = np.stack([rows @ radiance[:, :, c].astype(np.float64) for c in range(3)])
    return np.ascontiguousarray((halfway @ columns.T).transpose(1, 2, 0), dtype=np.float32)


def _cell_edges(size: int) -> Float64[F64, " edges"]:
    return np.linspace(0.0, 1.0, size + 1)


def _overlap(
    source_edges: Float64[F64, " sources"], target_edges: Float64[F64, " targets"]
) -> Float64[F64, "rows columns"]:
    """Give the matrix of means: row t holds the share of target t that each source covers."""
    lower = np.maximum(target_edges[:-1, None], source_edges[None, :-1])
    upper = np.minimum(target_edges[1:, None], source_edges[None, 1:])
    covered = np.maximum(upper - lower, 0.0)
    return np.asarray(covered / covered.sum(axis=1, keepdims=True))


def resample(
    lookup: Lookup,
    height: int,
    width: int,
    *,
    supersample: int = 4,
    rotation: Float64[F64, "3 3"] | None = None,
) -> Float32[F32, "height width 3"]:
    """Average a lookup over ``supersample``^2 places of equal solid angle in each lat-long texel.

    The hundredth of the texels around which the power varies most (the rims of lamps and suns, a
    few of which can hold most of the light) is averaged again over 16 times as many places.  With
    a rotation R the result is L'(d) = L(R^T d).
    """

    def texels(indices: I64, n: int) -> F64:
        directions = _places_in_texels(indices, height, width, n)
        if rotation is not None:
            directions = directions @ rotation
        return np.asarray(lookup(directions).reshape(len(indices), n * n, 3).mean(axis=1))

    result = np.empty((height * width, 3), dtype=np.float32)
    at_a_time = max(1, _SAMPLES_AT_A_TIME // supersample**2)
    for first in range(0, height * width, at_a_time):
        chunk = np.arange(first, min(first + at_a_time, height * width))
        result[chunk] = texels(chunk, supersample)
    uneven = _most_uneven(result.reshape(height, width, 3), height * width // 100)
    finer = 4 * supersample
    at_a_time = max(1, _SAMPLES_AT_A_TIME // finer**2)
    for first in range(0, len(uneven), at_a_time):
        chunk = uneven[first : first + at_a_time]
        result[chunk] = texels(chunk, finer)
    return result.reshape(height, width, 3)


def _places_in_texels(
    indices: Int64[I64, " texels"], height: int, width: int, n: int
) -> Float64[F64, "dirs 3"]:
    """Give n x n directions in each texel, evenly spread over its solid angle."""
    offsets = (np.arange(n) + 0.5) / n
    cos_edges = np.cos(np.arange(height + 1) / height * np.pi)
    row, column = np.divmod(indices, width)
    azimuth = (column[:, None] + offsets) * (2 * np.pi / width) - np.pi
    top, bottom = cos_edges[row][:, None], cos_edges[row + 1][:, None]
    cos_polar = top + (bottom - top) * offsets
    horizontal = np.sqrt(np.maximum(0.0, 1.0 - cos_polar**2))[:, :, None]
    places = np.empty((len(indices), n, n, 3))
    places[..., 0] = horizontal * np.sin(azimuth)[:, None, :]
    places[..., 1] = cos_polar[:, :, None]
    places[..., 2] = -horizontal * np.cos(azimuth)[:, None, :]
    return places.reshape(-1, 3)


def _most_uneven(radiance: Float32[F32, "height width 3"], count: int) -> Int64[I64, " texels"]:
    """Find the texels around which power (radiance times solid angle) varies most."""
    height = radiance.shape[0]
    power = radiance.sum(axis=2) * np.sin((np.arange(height) + 0.5) / height * np.pi)[:, None]
    spread = maximum_filter(power, 3, mode=("nearest", "wrap")) - minimum_filter(
        power, 3, mode=("nearest", "wrap")
    )
    order = np.argsort(spread, axis=None, kind="stable")[::-1][:count]
    return np.sort(order[spread.ravel()[order] > 0]).astype(np.int64)
