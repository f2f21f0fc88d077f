"""How few rays a vertex will do, tried at some vertices and their neighbours.

Where means over neighbours take most of what few rays leave to chance, fewer of them suffice; how
many depends on how fast bounced light changes along the surface, which only light itself tells.
"""

from collections.abc import Callable
from math import ceil
from typing import Any

import numpy as np

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.transport.bounce_error import draw_vertices, mean_error
from prtbake_workers.transport.smoothing import Smoothing

VERTICES = 64
"""Tried; with their neighbours some 450."""

FEWEST = 8
"""Rays tried first."""

TRIALS = 2
"""Numbers tried: the second is what the first one's error asks for if all of it is chance.  Where
that does not do either, means blur too much and more rays would not help."""

MARGIN = 1.1
"""More rays than chance alone asks for."""

FALL = 4.0 / 3.0
"""Squared errors by chance fall with the rays to this power, see `planning.bounce_rays`."""


def pilot_rays(
    gather: Callable[[Int64[I64, " verts"], int, int], F32],
    smoothing: Smoothing,
    areas: Float64[F64, " verts"],
    *,
    most: int,
    allowed: float,
    seed: int,
) -> int:
    """Find the fewest rays a vertex whose bounce, after one round of means, errs less than allowed.

    Parameters
    ----------
    gather
        The bounce of a part: from vertices of the part, rays of each and a seed to what they
        receive, (verts, channels, terms, coeffs).
    smoothing
        Means over the part.
    areas
        Of the part's vertices.
    most
        Rays to take if fewer do not do; these are not tried.
    allowed
        Mean squared error of a vertex.
    seed
        Of the rays; those that the error is measured against take the two after it.
    """
    if most <= FEWEST or not areas.sum() > 0.0:
        return most
    chosen = draw_vertices(areas, VERTICES, seed)
    around, rows = smoothing.rows(chosen)
    x, y = (gather(chosen, most, seed + step) for step in (1, 2))
    n_rays = FEWEST
    for _ in range(TRIALS):
        tried = gather(around, n_rays, seed)
        smooth = np.stack(
            [_product(rows, tried[:, channel]) for channel in range(tried.shape[1])], axis=1
        )
        error = mean_error(smooth, x, y)
        if error <= allowed:
            return n_rays
        if allowed <= 0.0:
            break
        n_rays = ceil(MARGIN * n_rays * (error / allowed) ** (1.0 / FALL))
        if n_rays >= most:
            break
    return most


def _product(
    rows: Any, received: Float32[F32, "around terms coeffs"]
) -> Float32[F32, "verts terms coeffs"]:
    n_terms, n_coeffs = received.shape[1:]
    flat = np.ascontiguousarray(received).reshape(-1, n_coeffs)
    return np.asarray(rows @ flat).reshape(-1, n_terms, n_coeffs)
