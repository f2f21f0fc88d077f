"""What few rays leave of bounces to chance, and how far means over neighbours mend it.

With x and y two fresh draws of a row, t the truth and f anything that shares no ray with them,
``E <f - x, f - y> = |f - t|^2``: chance and blur together, without bias.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.smoothing import ROUNDS, Smoothing

VERTICES = 128
"""Of each part, gathered again, twice."""

Gather = Callable[[int, I64, int], F32]
"""From a part, vertices in scene numbering and a seed to what these receive."""


class BounceError(NamedTuple):
    """Expected squared errors of bounces, area-weighted, and the rounds of means behind them."""

    energy: Float64[F64, " parts"]
    rounds: tuple[int, ...]


def row_norms(
    transfer: Float32[F32, "verts channels terms coeffs"],
) -> Float64[F64, "verts channels"]:
    """Norms of every vertex and channel: rows in float32, their sums in float64."""
    rows = transfer.reshape(len(transfer), transfer.shape[1], -1)
    return np.asarray(np.sqrt(np.vecdot(rows, rows).astype(np.float64)))


class Drawn(NamedTuple):
    """Vertices, in order, and how large a share of all draws fell on each."""

    vertices: Int64[I64, " distinct"]
    shares: Float64[F64, " distinct"]


def draw_vertices(areas: Float64[F64, " verts"], count: int, seed: Sequence[int]) -> Drawn:
    """Draw vertices by area."""
    weights = np.maximum(areas, 0.0)
    rng = np.random.default_rng(seed)
    drawn = rng.choice(len(areas), count, p=weights / weights.sum())
    vertices, counts = np.unique(drawn, return_counts=True)
    return Drawn(vertices, counts / count)


def squared_errors(
    found: Float32[F32, "verts channels terms coeffs"],
    first: Float32[F32, "verts channels terms coeffs"],
    second: Float32[F32, "verts channels terms coeffs"],
) -> Float64[F64, " verts"]:
    """Estimate the squared error of each row from two draws of it; one alone may be negative."""
    return np.asarray(((found - first) * (found - second)).sum(axis=(1, 2, 3), dtype=np.float64))


def with_standard_error(errors: Float64[F64, " verts"], drawn: Drawn) -> float:
    """Give the mean, not below 0, and one standard error of it on top."""
    return max(float(drawn.shares @ errors), 0.0) + _standard_error(errors, drawn)


def bounce_error(
    scene: Scene,
    gather: Gather,
    bounced: Sequence[Float32[F32, "_ channels _ coeffs"] | None],
    smoothings: Sequence[Smoothing | None],
    *,
    seed: int,
    rounds: Sequence[int] | None = None,
) -> BounceError:
    """Measure the squared error of what bounces brought, and choose the means that lower it.

    Rounds are taken where the error falls by more than the standard error of its fall.

    Parameters
    ----------
    scene
        All parts.
    gather
        Fresh draws of the same at some vertices.
    bounced
        What was brought, one array a part; None where half of ``|x - y|^2`` is to stand for it,
        which is the error of a fresh draw.
    smoothings
        Means over each part, or None.
    seed
        Of the vertices; the draws take the two after it.
    rounds
        Taken as they are, a number a part, where given.
    """
    energy = np.zeros(len(scene.part_ranges))
    taken = [0] * len(energy)
    for part, (start, stop) in enumerate(scene.part_ranges):
        areas = np.maximum(scene.areas[start:stop], 0.0)
        if not areas.sum() > 0.0:
            continue
        drawn = draw_vertices(areas, VERTICES, [seed, 1])
        chosen = drawn.vertices
        x, y = (gather(part, start + chosen, own) for own in (seed + 1, seed + 2))
        brought, smoothing = bounced[part], smoothings[part]
        if brought is None:
            errors = 0.5 * (row_norms(x - y) ** 2).sum(axis=1)
        else:
            plain = errors = squared_errors(brought[chosen], x, y)
            if smoothing is not None:
                tried = ROUNDS if rounds is None else (rounds[part],)
                for number in tried:
                    smooth = smoothing.at(chosen, number).apply(brought)
                    found = squared_errors(smooth, x, y)
                    fall, gain = plain - found, float(drawn.shares @ (errors - found))
                    clear = drawn.shares @ fall > _standard_error(fall, drawn)
                    if (clear and gain > 0.0) or rounds is not None:
                        errors, taken[part] = found, number
        energy[part] = float(areas.sum()) * with_standard_error(errors, drawn)
    return BounceError(energy, tuple(taken))


def _standard_error(values: Float64[F64, " verts"], drawn: Drawn) -> float:
    """Of a mean of independent vertices: what was drawn twice tells nothing new."""
    apart = drawn.shares * (values - drawn.shares @ values)
    return float(np.sqrt(apart @ apart))
