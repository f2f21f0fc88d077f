"""Clusters of vertices: their members, their means, and parts of them for the empty ones."""

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I32, Bool, Float32, Float64, Int32
from prtbake_workers.compress.energy import row_chunks, row_energy
from prtbake_workers.compress.rows import Rows

SPLIT_ITERATIONS = 3
# Rows are summed in pieces that stay in the cache, so that each is fetched from memory once.
PIECE_BYTES = 1 << 19


def members_by_cluster(labels: Int32[I32, " verts"], n_clusters: int) -> list[I32]:
    """Return the vertices of each cluster, rising."""
    order = np.argsort(labels, kind="stable").astype(np.int32)
    ends = np.cumsum(np.bincount(labels, minlength=n_clusters))
    return [order[a:b] for a, b in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True)]


def weighted_mean(
    signal: Float32[F32, "verts dims"], weights: Float64[F64, " verts"]
) -> Float32[F32, " dims"]:
    """Return the weighted mean of the rows; the plain mean where every weight is zero."""
    if not weights.any():
        weights = np.ones(len(weights))
    share = weights / weights.sum()
    mean = np.zeros(signal.shape[1])
    for piece in row_chunks(signal, PIECE_BYTES):
        mean += share[piece] @ signal[piece].astype(np.float64)
    return mean.astype(np.float32)


def squared_distances(
    signal: Float32[F32, "verts dims"], point: Float32[F32, " dims"]
) -> Float64[F64, " verts"]:
    """Return the squared distance of each row to one point, from the difference itself."""
    distance = np.empty(len(signal))
    for piece in row_chunks(signal, PIECE_BYTES):
        distance[piece] = row_energy(signal[piece] - point)
    return distance


def split_in_two(
    signal: Float32[F32, "verts dims"], weights: Float64[F64, " verts"]
) -> Bool[B8, " verts"] | None:
    """Cut rows into two groups by a short 2-means, or return None where all rows are the same.

    It starts from the row farthest from the mean and the row farthest from that one.
    """
    if len(signal) < 2:
        return None
    from_mean = squared_distances(signal, weighted_mean(signal, weights))
    one = signal[int(np.argmax(from_mean))]
    other = signal[int(np.argmax(squared_distances(signal, one)))]
    if np.array_equal(one, other):
        return None
    second = np.zeros(len(signal), dtype=np.bool_)
    for _ in range(SPLIT_ITERATIONS):
        nearer_other = squared_distances(signal, other) < squared_distances(signal, one)
        if nearer_other.all() or not nearer_other.any():
            break
        second = nearer_other
        one = weighted_mean(signal[~second], weights[~second])
        other = weighted_mean(signal[second], weights[second])
    return second if second.any() else None


def refill_empty_clusters(
    signal: Rows,
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
    weights: Float64[F64, " verts"],
    n_clusters: int,
) -> list[tuple[int, int]]:
    """Give every empty cluster a part of the one with the largest error that can be split.

    [Chen2005]_ section 3.1.2 splits the fullest cluster; the worst one has more to win.

    Parameters
    ----------
    signal, weights
        One (dims,) row a vertex, and the vertices' weights.
    labels
        Cluster of each vertex; changed in place for those that leave a donor.
    errors
        Squared error of each vertex, without its weight.  A vertex takes it along.
    n_clusters
        Clusters, empty ones included.

    Returns
    -------
    list of (cluster, donor)
        The clusters filled.  One stays empty where no cluster has both error and two different
        rows.
    """
    filled = []
    sizes = np.bincount(labels, minlength=n_clusters)
    for empty in np.flatnonzero(sizes == 0).tolist():
        totals = np.bincount(labels, weights=weights * errors, minlength=n_clusters)
        for donor in np.argsort(-totals, kind="stable").tolist():
            if totals[donor] <= 0.0:
                break
            verts = np.flatnonzero(labels == donor)
            second = split_in_two(signal[verts], weights[verts])
            if second is not None:
                labels[verts[second]] = empty
                filled.append((empty, donor))
                break
    return filled
