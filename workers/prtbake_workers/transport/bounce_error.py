"""What few rays leave of a bounce to chance, and how far means over neighbours mend it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.smoothing import ROUNDS, Smoothing

VERTICES = 128
"""Of each part, gathered again, twice."""

Gather = Callable[[int, I64, int], F32]
"""From a part, vertices in scene numbering and a seed to what these receive in one bounce."""


class BounceError(NamedTuple):
    """Expected squared errors of a bounce, area-weighted, and the rounds of means behind them."""

    energy: Float64[F64, " parts"]
    rounds: tuple[int, ...]


def row_norms(
    transfer: Float32[F32, "verts channels terms coeffs"],
) -> Float64[F64, "verts channels"]:
    """Norms of every vertex and channel: rows in float32, their sums in float64."""
    rows = transfer.reshape(len(transfer), transfer.shape[1], -1)
    return np.asarray(np.sqrt(np.vecdot(rows, rows).astype(np.float64)))


def draw_vertices(areas: Float64[F64, " verts"], count: int, seed: int) -> Int64[I64, " count"]:
    """Draw vertices by area, in order; some may come twice."""
    weights = np.maximum(areas, 0.0)
    rng = np.random.default_rng([seed, 1])
    return np.sort(rng.choice(len(areas), count, p=weights / weights.sum()))


def mean_error(
    found: Float32[F32, "verts channels terms coeffs"],
    first: Float32[F32, "verts channels terms coeffs"],
    second: Float32[F32, "verts channels terms coeffs"],
) -> float:
    """Estimate the mean squared error of rows from two independent draws of them without bias.

    One standard error of the estimate is added to it.
    """
    errors = ((found - first) * (found - second)).sum(axis=(1, 2, 3), dtype=np.float64)
    return float(errors.mean() + errors.std() / np.sqrt(len(errors)))


def bounce_error(
    scene: Scene,
    gather: Gather,
    *,
    seed: int,
    arriving: Sequence[Float32[F32, "_ channels _ coeffs"]] | None = None,
    smoothings: Sequence[Smoothing | None] = (),
    rounds: Sequence[int] | None = None,
) -> BounceError:
    """Measure the squared error of one bounce, part by part, and choose the rounds that lower it.

    With x and y two fresh draws of a row, half of ``|x - y|^2`` is expected to be the error of
    either, and ``<f - x, f - y>`` that of anything else, f: chance and blur together.  Rounds are
    taken where their error is the smaller by more than its own standard error, which is added.

    Parameters
    ----------
    scene
        All parts.
    gather
        The bounce, at some vertices.
    seed
        Of the vertices; the draws take the two after it.
    arriving
        The bounce everywhere, one array a part: what means are taken of.  None takes none.
    smoothings
        Means over each part, or None; empty for no part.
    rounds
        Taken as they are, a number a part, where given.
    """
    energy = np.zeros(len(scene.part_ranges))
    taken = [0] * len(energy)
    for part, (start, stop) in enumerate(scene.part_ranges):
        areas = np.maximum(scene.areas[start:stop], 0.0)
        if not areas.sum() > 0.0:
            continue
        chosen = draw_vertices(areas, VERTICES, seed)
        x, y = (gather(part, start + chosen, own) for own in (seed + 1, seed + 2))
        least = 0.5 * float((row_norms(x - y) ** 2).sum(axis=1).mean())
        smoothing = smoothings[part] if smoothings else None
        if smoothing is not None and arriving is not None and least > 0.0:
            tried = ROUNDS if rounds is None else tuple({rounds[part]} - {0})
            for number, smooth in zip(
                tried, smoothing.at(arriving[part], chosen, tried), strict=True
            ):
                if (error := mean_error(smooth, x, y)) < least or rounds is not None:
                    least, taken[part] = error, number
        energy[part] = float(areas.sum()) * least
    return BounceError(energy, tuple(taken))
