"""Enhanced LBG [Patane2001]_: clusters that do little are shifted to where they do more.

LBG ends in the nearest local minimum: a mean that shares a dense place with others stays there,
though a wide cluster elsewhere needs it more.  The utility of a cluster is its distortion over the
mean distortion of all.  A cluster i below 1 may leave its vertices to the one that is nearest to
it, l, and take a part of one above 1, p, that is drawn in proportion to its utility.  The shift is
made only where it lowers the distortion of the three,

    D_p - D_p' - D_i'  >  W_i W_l / (W_i + W_l) |m_i - m_l|^2,

whose right side is what merging i and l adds, W being the weights of their vertices.

The paper splits p along the diagonal of its box; here p is split as empty clusters' donors are,
from two vertices that are far apart.  Either leaves the same error to 1.5 %.
"""

from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I32, Bool, Float32, Float64
from prtbake_workers.compress.clusters import (
    members_by_cluster,
    split_in_two,
    squared_distances,
    weighted_mean,
)
from prtbake_workers.compress.energy import row_energy
from prtbake_workers.compress.lbg import Clustering
from prtbake_workers.compress.parallel import map_in_order

# A shift must win more than this share of what it splits: less could be rounding of the means.
LEAST_GAIN = 1e-6


class _Split(NamedTuple):
    """A cluster in two: who goes to the second, and the distortion that is left."""

    second: Bool[B8, " members"]
    distortion: float


def shift_clusters(
    signal: Float32[F32, "verts dims"],
    state: Clustering,
    weights: Float64[F64, " verts"],
    *,
    rng: np.random.Generator,
) -> int:
    """Attempt one shift of every cluster of low utility; return how many were made.

    Parameters
    ----------
    signal, weights
        One row a vertex, and the vertices' weights, >= 0.
    state
        Clusters with the means and distances of their members; all three change in place, and the
        weighted sum of squared distances falls with every shift.
    rng
        Draws the clusters of high utility.
    """
    return _Shifts(signal, state, weights).attempt(rng)


class _Shifts:
    """Members, weights, distortions and distances of the clusters while shifts go on."""

    def __init__(self, signal: F32, state: Clustering, weights: F64) -> None:
        self.signal, self.state, self.weights = signal, state, weights
        n_clusters = len(state.means)
        self.members = members_by_cluster(state.labels, n_clusters)
        self.mass = np.bincount(state.labels, weights=weights, minlength=n_clusters)
        self.distortion = np.bincount(
            state.labels, weights=weights * state.squared_distances, minlength=n_clusters
        )
        self.splits: dict[int, _Split | None] = {}
        # Distances between means only propose the neighbour: float32 products are enough.
        self.centre = state.means.mean(axis=0)
        self.centred: F32 = state.means - self.centre
        self.norms = row_energy(self.centred)
        self.products: F32 = self.centred @ self.centred.T

    def attempt(self, rng: np.random.Generator) -> int:
        """Go through the clusters, those that do least first."""
        n_shifts = 0
        worth = np.flatnonzero(self.distortion > self.distortion.mean()).tolist()
        self.splits |= dict(zip(worth, map_in_order(self._split, worth), strict=True))
        for low in np.argsort(self.distortion, kind="stable").tolist():
            mean = self.distortion.mean()
            if self.distortion[low] >= mean:
                continue
            pull = np.where(self.distortion > mean, self.distortion, 0.0)
            if not pull.any():  # all are the mean, to rounding
                break
            high = int(rng.choice(len(pull), p=pull / pull.sum()))
            near = self._nearest(low, high)
            if near is None:
                continue
            if high not in self.splits:
                self.splits[high] = self._split(high)
            split = self.splits[high]
            if split is None:
                continue
            gain = self.distortion[high] - split.distortion - self._merging(low, near)
            if gain > LEAST_GAIN * self.distortion[high]:
                self._shift(low, near, high, split)
                n_shifts += 1
        return n_shifts

    def _nearest(self, low: int, high: int) -> int | None:
        """Return the cluster nearest to ``low``, which is neither it nor ``high`` nor empty."""
        distance = self.norms - 2.0 * self.products[low]
        distance[[low, high]] = np.inf
        near = int(np.argmin(np.where(self.mass > 0.0, distance, np.inf)))
        return near if near not in (low, high) and self.mass[near] > 0.0 else None

    def _merging(self, low: int, near: int) -> float:
        """Return what is added to the distortion where one mean takes the place of two."""
        between = row_energy((self.state.means[low] - self.state.means[near])[None])[0]
        share = self.mass[low] * self.mass[near] / (self.mass[low] + self.mass[near])
        return float(share * between)

    def _split(self, cluster: int) -> _Split | None:
        verts = self.members[cluster]
        rows, weights = self.signal[verts], self.weights[verts]
        second = split_in_two(rows, weights)
        if second is None:
            return None
        distortion = 0.0
        for half in (~second, second):
            mean = weighted_mean(rows[half], weights[half])
            distortion += float(weights[half] @ squared_distances(rows[half], mean))
        return _Split(second, distortion)

    def _shift(self, low: int, near: int, high: int, split: _Split) -> None:
        """Give the vertices of ``low`` to ``near``, and a part of ``high`` to ``low``."""
        self.members[near] = np.sort(np.concatenate([self.members[near], self.members[low]]))
        verts = self.members[high]
        self.members[low], self.members[high] = verts[split.second], verts[~split.second]
        for cluster in (near, low, high):
            self._renew(cluster, self.members[cluster])
        changed = [near, low, high]
        self.centred[changed] = self.state.means[changed] - self.centre
        self.norms[changed] = row_energy(self.centred[changed])
        self.products[changed] = self.centred[changed] @ self.centred.T
        self.products[:, changed] = self.products[changed].T

    def _renew(self, cluster: int, verts: I32) -> None:
        """Bring a cluster's mean and sums, and its members' labels and distances, up to date."""
        rows, weights = self.signal[verts], self.weights[verts]
        mean = weighted_mean(rows, weights)
        distance = squared_distances(rows, mean)
        self.state.labels[verts] = cluster
        self.state.means[cluster] = mean
        self.state.squared_distances[verts] = distance
        self.mass[cluster] = weights.sum()
        self.distortion[cluster] = weights @ distance
        self.splits.pop(cluster, None)
