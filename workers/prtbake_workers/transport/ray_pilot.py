"""How few rays a vertex will do, tried at some vertices and their neighbours.

Where means over neighbours take most of what few rays leave to chance, fewer of them suffice; how
many depends on how fast bounced light changes along the surface, which only light itself tells.
"""

from collections.abc import Callable
from math import ceil

from prtbake_workers.arrays import F32, F64, I64, Float64, Int64
from prtbake_workers.transport.bounce_error import (
    draw_vertices,
    squared_errors,
    with_standard_error,
)
from prtbake_workers.transport.smoothing import Smoothing

VERTICES = 64
"""Tried; with their neighbours some 450."""

FEWEST = 4
"""Rays tried first; casting fewer would save little of what a bounce costs a vertex."""

WORTH_TRYING = 16
"""Rays that cost more than to try whether fewer will do."""

MARGIN = 1.1
"""More rays than chance alone asks for."""

FALL = 4.0 / 3.0
"""Squared errors by chance fall with the rays to this power.

Shifted lattices in two dimensions reach 3/2 where the integrand jumps, as radiance does at
silhouettes, and 1 where it is all noise; 1.35 to 1.47 was measured from 1 to 64 rays.
"""

BLURRED = 2.0
"""Times the error that chance alone would leave: above it means blur, and no ray mends that."""


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

    `FEWEST` are tried, then what their error asks for if all of it is chance.

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
        Of the bake: vertices and rays are others than those that it takes and is measured by.
    """
    if most < WORTH_TRYING or not allowed > 0.0 or not areas.sum() > 0.0:
        return most
    drawn = draw_vertices(areas, VERTICES, [seed, 2])
    chosen = drawn.vertices
    around, means = smoothing.around(chosen)
    x, y = (gather(chosen, most, seed + step) for step in (4, 5))

    def error_of(n_rays: int) -> float:
        found = means.apply(gather(around, n_rays, seed + 3))
        return with_standard_error(squared_errors(found, x, y), drawn)

    first = error_of(FEWEST)
    if first <= allowed:
        return FEWEST
    n_rays = _more(FEWEST, first / allowed)
    if n_rays >= most:
        return most
    second = error_of(n_rays)
    if second <= allowed:
        return n_rays
    if second > BLURRED * first * (FEWEST / n_rays) ** FALL:
        return most
    return min(most, _more(n_rays, second / allowed))


def _more(n_rays: int, ratio: float) -> int:
    more: int = ceil(MARGIN * n_rays * ratio ** (1.0 / FALL))
    return more
