"""Means of clusters while vertices move between them.

Sums in float64 are brought up to date by those who moved, which after the first iterations are few.
So is the distortion, the weighted sum of squared distances to the mean: with members of mass W and
mean u, it is about a point p by W |p - u|^2 more than about u.
"""

import numpy as np
from scipy.sparse import csr_array

from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int32
from prtbake_workers.compress.clusters import members_by_cluster, squared_distances, weighted_mean
from prtbake_workers.compress.energy import row_chunks, row_energy
from prtbake_workers.compress.parallel import each_in_order, map_in_order
from prtbake_workers.compress.rows import Rows

CHUNK_BYTES = 8 << 20
"""Of signal in one piece of work."""

PIECE_BYTES = 1 << 19
"""Of signal at a time: it, twice that in float64 and the means beside it stay in the cache."""

MOST_MOVED = 0.5
"""Share of a cluster that joins or leaves, above which it is summed anew."""

LEAST_LEFT = 0.05
"""Of the largest distortion since a cluster was measured, below which it is measured anew: float32
differences know that one to 1e-7."""

LARGEST_RATIO = 1e4
"""Of the longest row that was ever in a sum over all lengths in it; a sum that held a longer one is
taken anew, as float64 leaves 1e-16 of what was taken away."""


class MovingMeans:
    """Weighted sums of the members of every cluster, and their distortion."""

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
        self._means: F32 = np.zeros((n_clusters, signal.shape[1]), np.float32)
        self._distortions: F64 = np.zeros(n_clusters)
        self._most: F64 = np.zeros(n_clusters)
        self._measured = (self._labels, self._means)

    @property
    def distortion(self) -> float:
        """Weighted sum of squared distances to the means, as of the last update."""
        return float(self._distortions.sum())

    def update(self, labels: Int32[I32, " verts"], means: Float32[F32, "clusters dims"]) -> None:
        """Set every mean to that of its members, zero where there are none.

        Parameters
        ----------
        labels
            Cluster of each vertex.
        means
            Changes in place.
        """
        n_clusters = len(means)
        moved = np.flatnonzero(labels != self._labels)
        new, old = labels[moved], self._labels[moved]
        known = old >= 0
        n_moved = np.bincount(new, minlength=n_clusters)
        n_moved += np.bincount(old[known], minlength=n_clusters)
        number = np.bincount(labels, minlength=n_clusters)
        mass = np.bincount(labels, weights=self._weights, minlength=n_clusters)
        size = np.bincount(labels, weights=self._sizes, minlength=n_clusters)
        np.maximum.at(self._longest, new, self._sizes[moved])
        anew = (n_moved > MOST_MOVED * number) | ~(self._longest <= LARGEST_RATIO * size)
        anew |= mass == 0.0
        kept = ~anew
        if kept.any():
            self._follow(moved[kept[new]], 1.0, new[kept[new]])
            left = known & kept[old]
            self._follow(moved[left], -1.0, old[left])
            exact = self._sums[kept] / mass[kept, None]
            gone = np.sum((self._means[kept] - exact) ** 2, axis=1)
            self._distortions[kept] -= mass[kept] * gone
            means[kept] = exact.astype(np.float32)
        unsure = kept & (self._distortions < LEAST_LEFT * self._most)
        work = np.flatnonzero(anew | unsure)
        if len(work):
            members = members_by_cluster(labels, n_clusters)

            def renew(cluster: int) -> None:
                own = members[cluster]
                rows, weights = self._signal[own], self._weights[own]
                if anew[cluster]:
                    self._sums[cluster] = weighted_sum(rows, weights)
                    self._longest[cluster] = self._sizes[own].max(initial=0.0)
                    means[cluster] = self._mean(cluster, rows, weights, mass[cluster])
                distances = squared_distances(rows, means[cluster])
                self._distortions[cluster] = self._most[cluster] = weights @ distances

            map_in_order(renew, work.tolist())
        self._labels, self._means = labels.copy(), means.copy()

    def _mean(self, cluster: int, rows: F32, weights: F64, mass: float) -> F32:
        """Return the mean of members, the plain one where they have no weight, zero of nobody."""
        if len(rows) == 0:
            return np.zeros(rows.shape[1], np.float32)
        if mass == 0.0:
            return weighted_mean(rows, weights)
        mean: F32 = (self._sums[cluster] / mass).astype(np.float32)
        return mean

    def _follow(self, verts: I64, sign: float, clusters: I32) -> None:
        """Add vertices to the sums and distortions of clusters, or take them away.

        Distortions are about where the means were.  Costs and holds what moved, however many
        clusters there are.
        """

        def follow(chunk: slice) -> tuple[I32, F64, F64]:
            present, at = np.unique(clusters[chunk], return_inverse=True)
            sums = np.zeros((len(present), self._sums.shape[1]))
            distortions = np.zeros(len(present))
            # by clusters, so that the rows of a piece add to few of them
            order = np.argsort(at, kind="stable")
            for piece in _pieces(slice(0, len(order)), self._signal):
                own, there = verts[chunk][order[piece]], at[order[piece]]
                few = slice(there[0], there[-1] + 1)
                rows, weights = self._signal[own], self._weights[own]
                shares = csr_array(
                    (weights, (there - there[0], np.arange(len(own)))),
                    shape=(few.stop - few.start, len(own)),
                )
                sums[few] += shares @ rows.astype(np.float64)
                far = weights * row_energy(rows - self._means[present[there]])
                distortions[few] += np.bincount(there - there[0], weights=far)
            return present, sums, distortions

        for present, sums, distortions in each_in_order(follow, _chunks(len(verts), self._signal)):
            self._sums[present] += sign * sums
            self._distortions[present] += sign * distortions
        np.maximum(self._most, self._distortions, out=self._most)

    def measure(
        self,
        labels: Int32[I32, " verts"],
        means: Float32[F32, "clusters dims"],
        squared_distances: Float64[F64, " verts"],
    ) -> None:
        """Bring squared distances up to date, from the differences themselves.

        Parameters
        ----------
        labels, means
            Of the vertices and clusters, whoever set them.
        squared_distances
            Of each vertex to its mean as of the last call; changes in place.
        """
        last_labels, last_means = self._measured
        changed = np.any(means != last_means, axis=1)
        verts = np.flatnonzero(changed[labels] | (labels != last_labels))

        def measure(chunk: slice) -> None:
            for piece in _pieces(chunk, self._signal):
                own = verts[piece]
                # neighbours are read where they lie
                whole = own[-1] - own[0] == len(own) - 1
                rows = self._signal[own[0] : own[-1] + 1] if whole else self._signal[own]
                difference = means[labels[own]]
                np.subtract(rows, difference, out=difference)
                squared_distances[own] = row_energy(difference)

        map_in_order(measure, _chunks(len(verts), self._signal))
        self._measured = (labels.copy(), means.copy())


def weighted_sum(
    rows: Float32[F32, "verts dims"], weights: Float64[F64, " verts"]
) -> Float64[F64, " dims"]:
    """Return the weighted sum of the rows, in float64."""
    total = np.zeros(rows.shape[1])
    for piece in row_chunks(rows, PIECE_BYTES):
        total += weights[piece] @ rows[piece].astype(np.float64)
    return total


def _chunks(n_verts: int, signal: Rows) -> list[slice]:
    """Cut so many vertices into pieces of work."""
    step = max(1, CHUNK_BYTES // max(1, 4 * signal.shape[1]))
    return [slice(one, min(n_verts, one + step)) for one in range(0, n_verts, step)]


def _pieces(verts: slice, signal: Rows) -> list[slice]:
    """Cut a run of vertices into pieces whose rows stay in the cache."""
    step = max(1, PIECE_BYTES // max(1, 4 * signal.shape[1]))
    return [slice(one, min(verts.stop, one + step)) for one in range(verts.start, verts.stop, step)]
