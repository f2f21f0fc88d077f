"""Cosine-distributed directions: one low-discrepancy pattern, shifted anew for every point."""

import numpy as np

from prtbake_workers.arrays import F64, Float64

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def lattice(n: int) -> Float64[F64, "samples 2"]:
    """Spread n points over the unit square: ((i + 1/2) / n, frac(i / golden ratio)).

    Every 1/n of the first axis holds one point, and the second axis never comes near itself
    (Kronecker sequence of the golden ratio), for any n.
    """
    i = np.arange(n)
    return np.stack([(i + 0.5) / n, (i * GOLDEN) % 1.0], axis=1)


def shifts(seed: int, start: int, stop: int, n_axes: int) -> Float64[F64, "points axes"]:
    """Draw the shifts of points start..stop, the same however the points are cut into blocks."""
    stream = np.random.PCG64(seed)
    # one 64-bit output a float64: the stream of all points, entered where the block begins
    stream.advance(start * n_axes)
    return np.random.Generator(stream).random((stop - start, n_axes))


def shifted(
    pattern: Float64[F64, "samples axes"], shift: Float64[F64, "points axes"]
) -> Float64[F64, "points samples axes"]:
    """Move a pattern on the torus, once for each point ([CranleyPatterson1976]_).

    Each sample is uniform by itself, so means over them are unbiased.
    """
    moved = pattern[None] + shift[:, None]
    moved -= np.floor(moved)
    # 1 - tiny + tiny may round to 1
    return np.minimum(moved, np.nextafter(1.0, 0.0), out=moved)


def cosine_directions(square: Float64[F64, "... 2"]) -> Float64[F64, "... 3"]:
    """Map the unit square to local directions with density cos(theta) / pi; z is positive."""
    sine = np.sqrt(square[..., 0])
    azimuth = 2.0 * np.pi * square[..., 1]
    return np.stack(
        [sine * np.cos(azimuth), sine * np.sin(azimuth), np.sqrt(1.0 - square[..., 0])], axis=-1
    )
