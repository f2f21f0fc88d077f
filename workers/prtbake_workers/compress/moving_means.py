"""Means of clusters while vertices move between them.

Sums in float64 are brought up to date by those who moved, which after the first iterations are few.
"""

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int32
from prtbake_workers.compress.clusters import members_by_cluster, weighted_mean
from prtbake_workers.compress.energy import row_chunks, row_energy
from prtbake_workers.compress.parallel import map_in_order
from prtbake_workers.compress.rows import Rows

CHUNK_BYTES = 8 << 20
"""Of signal in one piece of work."""

PIECE_BYTES = 1 << 19
"""Of signal at a time: it and the means beside it stay in the cache."""

MOST_MOVED = 0.5
"""Share of a cluster that joins or leaves, above which it is summed anew."""

LARGEST_RATIO = 1e4
"""Of the longest row that was ever in a sum over all lengths in it; a sum that held a longer one is
taken anew, as float64 leaves 1e-16 of what was taken away."""


class MovingMeans:
    """Weighted sums of the members of every cluster."""

    def __init__(
        self,
        signal: Rows,
        weights: Float64[F64, " verts"],
        energy: Float64[F64, " verts"],
        n_clusters: int,
    ) -> None:
        """Take the signal, the vertices' weights, >= 0, and the squared norm of each row."""
        self._signal, self._weights = signal, weights
        self._sizes: F64 = weights * np.sqrt(energy)
        self._sums: F64 = np.zeros((n_clusters, signal.shape[1]))
        self._longest: F64 = np.full(n_clusters, np.inf)
        self._labels: I32 = np.full(len(signal), -1, dtype=np.int32)

    def update(
        self,
        labels: Int32[I32, " verts"],
        means: Float32[F32, "clusters dims"],
        squared_distances: Float64[F64, " verts"],
    ) -> None:
        """Set every mean to that of its members, zero where there are none; distances to match.

        Parameters
        ----------
        labels
            Cluster of each vertex.
        means
            Changes in place.
        squared_distances
            Of each vertex to its mean as it is, infinite where not known; changes in place.
        """
        n_clusters = len(means)
        before = means.copy()
        members = members_by_cluster(labels, n_clusters)
        moved = np.flatnonzero(labels != self._labels)
        joined = _parts(moved, labels[moved], n_clusters)
        left = _parts(moved, self._labels[moved], n_clusters)
        self._labels = labels.copy()
        mass = np.bincount(labels, weights=self._weights, minlength=n_clusters)
        size = np.bincount(labels, weights=self._sizes, minlength=n_clusters)

        def renew(cluster: int) -> None:
            own, new, old = members[cluster], joined[cluster], left[cluster]
            if len(own) == 0:
                means[cluster], self._longest[cluster] = 0.0, np.inf
                return
            longest = max(self._longest[cluster], self._sizes[new].max(initial=0.0))
            anew = len(new) + len(old) > MOST_MOVED * len(own)
            if mass[cluster] == 0.0:
                means[cluster] = weighted_mean(self._signal[own], self._weights[own])
                self._longest[cluster] = np.inf
                return
            if anew or not longest <= LARGEST_RATIO * size[cluster]:
                self._sums[cluster] = weighted_sum(self._signal[own], self._weights[own])
                self._longest[cluster] = self._sizes[own].max()
            else:
                self._sums[cluster] += weighted_sum(self._signal[new], self._weights[new])
                self._sums[cluster] -= weighted_sum(self._signal[old], self._weights[old])
                self._longest[cluster] = longest
            means[cluster] = (self._sums[cluster] / mass[cluster]).astype(np.float32)

        map_in_order(renew, range(n_clusters))
        changed = np.any(means != before, axis=1)
        changed[labels[moved]] = True
        stale = np.flatnonzero(changed[labels] | np.isinf(squared_distances))
        self._measure(stale, labels, means, squared_distances)

    def _measure(self, verts: I64, labels: I32, means: F32, squared_distances: F64) -> None:
        """Take the squared distances of some vertices, rising, from the differences themselves."""
        row_bytes = max(1, 4 * self._signal.shape[1])
        per_piece = max(1, PIECE_BYTES // row_bytes)
        per_chunk = max(1, CHUNK_BYTES // row_bytes)

        def measure(start: int) -> None:
            buffer = np.empty((per_piece, self._signal.shape[1]), np.float32)
            stop = min(len(verts), start + per_chunk)
            for first in range(start, stop, per_piece):
                own = verts[first : min(stop, first + per_piece)]
                # neighbours are read where they lie
                whole = own[-1] - own[0] == len(own) - 1
                rows = self._signal[own[0] : own[-1] + 1] if whole else self._signal[own]
                difference = buffer[: len(own)]
                np.take(means, labels[own], axis=0, out=difference, mode="clip")
                np.subtract(rows, difference, out=difference)
                squared_distances[own] = row_energy(difference)

        map_in_order(measure, range(0, len(verts), per_chunk))


def weighted_sum(
    rows: Float32[F32, "verts dims"], weights: Float64[F64, " verts"]
) -> Float64[F64, " dims"]:
    """Return the weighted sum of the rows, in float64."""
    total = np.zeros(rows.shape[1])
    for piece in row_chunks(rows, PIECE_BYTES):
        total += weights[piece] @ rows[piece].astype(np.float64)
    return total


def _parts(verts: I64, clusters: I32, n_clusters: int) -> list[I64]:
    """Return the vertices by cluster; those of none, -1, are left out."""
    known = clusters >= 0
    order = members_by_cluster(clusters[known], n_clusters)
    return [verts[known][own] for own in order]
