"""Clusters of vertices whose signals lie near their cluster's mean.

The LBG iteration [Linde1980]_ as [Sloan2003]_ section 4.1 uses it, with empty clusters re-seeded by
splitting ([Chen2005]_ section 3.1.2), from seeds that are spread by squared distance or that lie
anywhere in the signal's box.  Vector quantisation and the clusters of CPCA are these; CTA starts
from them.  With coherence, vertices also pay for being far from the rest of their cluster on
the mesh (`coherence`).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.compress.clusters import refill_empty_clusters
from prtbake_workers.compress.coherence import ClusterPlaces, Coherence, cheapest_clusters
from prtbake_workers.compress.energy import row_chunks, row_energy, row_energy_by_chunks
from prtbake_workers.compress.monotone import ObjectiveTrace
from prtbake_workers.compress.moving_means import MovingMeans
from prtbake_workers.compress.nearest_means import NearestMeans, centred_means
from prtbake_workers.compress.parallel import map_in_order
from prtbake_workers.compress.progress import Progress, no_progress
from prtbake_workers.compress.rows import Rows

# Seeds are drawn from this many vertices a cluster: enough to meet every region of the signal,
# and few enough that seeding costs less than one iteration.
SEED_VERTS_PER_CLUSTER = 24
# Squared distances below this share of the two squared norms are float32 rounding: the same point.
SAME_POINT = 1e-6

Start = Literal["spread", "hyper_box"]


@dataclass
class Clustering:
    """What an iteration changes in place.

    Attributes
    ----------
    labels
        Cluster of each vertex.
    means
        Mean signal of each cluster.
    squared_distances
        Squared distance of each vertex to its mean, without its weight; up to date for `Improve`.
    """

    labels: I32
    means: F32
    squared_distances: F64


Improve = Callable[[F32, Clustering, F64], int]
"""Takes signal, clustering and weights, lowers the objective, and tells how many clusters moved."""


class LbgResult(NamedTuple):
    """Clusters of vertices.

    Attributes
    ----------
    labels
        Cluster of each vertex.
    means
        Mean signal of each cluster; zeros for an empty one, which no split could fill.
    objective
        Weighted sum of squared distances to the means, after each iteration; the last one is that
        of ``squared_distances``.
    squared_distances
        Squared distance of each vertex to its mean, without its weight.
    """

    labels: Int32[I32, " verts"]
    means: Float32[F32, "clusters dims"]
    objective: list[float]
    squared_distances: Float64[F64, " verts"]


def lbg(
    signal: Rows,
    n_clusters: int,
    *,
    rng: np.random.Generator,
    weights: Float64[F64, " verts"],
    max_iterations: int,
    tolerance: float = 1e-4,
    start: Start = "spread",
    improve: Improve | None = None,
    coherence: Coherence | None = None,
    progress: Progress = no_progress,
) -> LbgResult:
    """Cluster the rows of ``signal`` by their distance to the clusters' means.

    Parameters
    ----------
    signal
        (verts, dims), one row a vertex.
    n_clusters
        Clusters wanted, 1 to the number of vertices; some stay empty only where the signal has
        fewer distinct rows.
    rng
        Source of the seeds.
    weights
        Weight of each vertex in means and objective, >= 0.
    max_iterations, tolerance
        Stop after so many iterations, when none moves, or when one wins less than this share of
        the objective.
    start
        ``spread``: seeds are vertices far from each other.  ``hyper_box``: points drawn evenly from
        the box that holds the signal ([Chen2005]_ section 3.1.2); where one attracts no vertex, its
        cluster is a part of another.
    improve
        Called once an iteration, when clusters have their members and their means.
    coherence
        Adds what distance on the mesh costs, from the second iteration on, when there are
        clusters to be near to; None for the signal alone.
    progress
        Called after each iteration.

    Raises
    ------
    ObjectiveRose
        Where the squared error rises, or was followed below what is measured in the end: see
        `ObjectiveTrace`.

    Notes
    -----
    A vertex moves only when its squared distance, taken as the difference itself, falls
    (`NearestMeans`).  So rounding moves nobody, and the objective never rises, but with coherence:
    then a vertex may go farther in the signal.
    """
    if start == "hyper_box":
        means = _means_in_box(signal, n_clusters, rng)
    else:
        means = _seed_means(signal, n_clusters, rng, weights)
    state = Clustering(np.zeros(len(signal), dtype=np.int32), means, np.full(len(signal), np.inf))
    energies = row_energy_by_chunks(signal)
    energy = float(weights @ energies)
    nearest = NearestMeans(signal, means, energies)
    moving = MovingMeans(signal, weights, energies, n_clusters)
    trace = ObjectiveTrace(energy, "LBG", may_rise=coherence is not None)
    unit = float(np.sqrt(energy / weights.sum())) if energy > 0.0 else 1.0
    for iteration in range(max_iterations):
        if coherence is None or iteration == 0:
            n_moved = nearest.move(state.labels, state.means)
        else:
            n_moved = _classify_coherently(signal, state, coherence, unit)
        if np.bincount(state.labels, minlength=n_clusters).min() == 0:
            moving.measure(state.labels, state.means, state.squared_distances)
            refill_empty_clusters(
                signal, state.labels, state.squared_distances, weights, n_clusters
            )
        moving.update(state.labels, state.means)
        distortion = moving.distortion
        if improve is not None:
            moving.measure(state.labels, state.means, state.squared_distances)
            n_moved += improve(signal[:], state, weights)
            distortion = float(weights @ state.squared_distances)
        trace.append(distortion)
        progress((iteration + 1) / max_iterations, f"clustering, error {trace.ratio:.3%}")
        if n_moved == 0 or trace.has_converged(tolerance):
            break
        if iteration + 1 < max_iterations and not trace.has_time():
            break
    moving.measure(state.labels, state.means, state.squared_distances)
    trace.measured(float(weights @ state.squared_distances))
    return LbgResult(state.labels, state.means, trace.values, state.squared_distances)


def _means_in_box(
    signal: Rows, n_clusters: int, rng: np.random.Generator
) -> Float32[F32, "clusters dims"]:
    """Draw points evenly from the smallest box that holds every row."""
    parts = (signal[chunk] for chunk in row_chunks(signal))
    ends = np.array([(part.min(axis=0), part.max(axis=0)) for part in parts])
    lowest, highest = ends[:, 0].min(axis=0), ends[:, 1].max(axis=0)
    share = rng.random((n_clusters, signal.shape[1]), dtype=np.float32)
    return np.asarray(lowest + share * (highest - lowest), dtype=np.float32)


def _seed_means(
    signal: Rows,
    n_clusters: int,
    rng: np.random.Generator,
    weights: Float64[F64, " verts"],
) -> Float32[F32, "clusters dims"]:
    """Draw seeds, each with probability proportional to its distance from those before.

    The rule of [Arthur2007]_, on a sample of the vertices, with squared distances taken about the
    sample's mean so that a large constant part of the signal cancels nothing.
    """
    n_verts = len(signal)
    n_sample = min(n_verts, max(1024, SEED_VERTS_PER_CLUSTER * n_clusters))
    if not weights.any():
        weights = np.ones(n_verts)
    sample = np.sort(rng.choice(n_verts, size=n_sample, replace=False))
    points = signal[sample]
    points -= points.mean(axis=0, dtype=np.float64).astype(np.float32)
    share = np.where(weights[sample] > 0.0, weights[sample], 0.0)
    share = share / share.sum() if share.any() else np.full(n_sample, 1.0 / n_sample)
    energy = row_energy(points)
    chosen = [int(rng.choice(n_sample, p=share))]
    nearest = np.full(n_sample, np.inf)
    while True:
        seed = chosen[-1]
        distance = energy + energy[seed] - 2.0 * (points @ points[seed])
        distance[distance < SAME_POINT * (energy + energy[seed])] = 0.0
        nearest = np.minimum(nearest, distance)
        nearest[seed] = 0.0
        pull = share * nearest
        if len(chosen) == n_clusters or not pull.any():
            break
        chosen.append(int(rng.choice(n_sample, p=pull / pull.sum())))
    # Too few distinct points: the clusters left over start where the first does, and stay empty
    # or are filled by a split.
    chosen += [chosen[0]] * (n_clusters - len(chosen))
    return signal[sample[chosen]]


def _classify_coherently(signal: Rows, state: Clustering, coherence: Coherence, unit: float) -> int:
    """Move each vertex to the cluster that costs it least, near in signal and on the mesh."""
    offset = state.means.mean(axis=0, dtype=np.float64).astype(np.float32)
    centred, constant, _ = centred_means(state.means, offset)
    places = ClusterPlaces(coherence, state.labels, len(state.means))

    def move(chunk: slice) -> int:
        rows = signal[chunk]
        squared = row_energy(rows - offset)[:, None] + constant - 2.0 * (rows @ centred.T)
        distances = np.sqrt(np.maximum(squared, 0.0)) / unit
        proposed = cheapest_clusters(places, chunk, state.labels, distances)
        movers = np.flatnonzero(proposed != state.labels[chunk])
        state.labels[chunk][movers] = proposed[movers]
        return len(movers)

    return sum(map_in_order(move, row_chunks(signal)))
