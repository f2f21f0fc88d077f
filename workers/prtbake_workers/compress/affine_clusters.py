"""Clusters of vertices, each approximated by an affine subspace: a mean and components of its own.

x~ = mean_c + sum_p w_xp component_cp ([Sloan2003]_ section 3.3).  The model step gives every
cluster the subspace of least squared error, which is its mean and the leading directions of its
members about it; so neither it nor moving a vertex to a subspace nearer by can raise the error.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int32, Int64
from prtbake_workers.compress.clusters import (
    members_by_cluster,
    refill_empty_clusters,
    weighted_mean,
)
from prtbake_workers.compress.coherence import Coherence, CoherentMoves
from prtbake_workers.compress.energy import row_energy, row_energy_by_chunks
from prtbake_workers.compress.parallel import map_in_order

RowSpace = Callable[[F64, int], F64]
"""Gives an orthonormal basis of a matrix's leading right singular vectors, as rows, strongest
first: `gram_eigh.leading_row_space` or `power_iteration.leading_row_space`."""


class AffineSubspace(NamedTuple):
    """Mean and components of one cluster.

    Attributes
    ----------
    mean
        Mean of the members.
    basis
        Orthonormal components, strongest first: as many as were found.
    gains
        What each component takes off the cluster's squared error: D_i^2 of [Sloan2003]_.
    """

    mean: Float32[F32, " dims"]
    basis: Float32[F32, "pcs dims"]
    gains: Float64[F64, " pcs"]

    def cut(self, rank: int) -> "AffineSubspace":
        """Return the subspace of the first ``rank`` components."""
        return AffineSubspace(self.mean, self.basis[:rank], self.gains[:rank])


def fit_subspace(
    rows: Float32[F32, "verts dims"],
    weights: Float64[F64, " verts"],
    n_components: int,
    row_space: RowSpace,
) -> AffineSubspace:
    """Return the affine subspace of least weighted squared error, of at most so many dimensions.

    Where every weight is zero the vertices count alike.
    """
    mean = weighted_mean(rows, weights)
    scaled = (rows - mean).astype(np.float64)
    scaled *= np.sqrt(weights if weights.any() else np.ones(len(weights)))[:, None]
    basis = row_space(scaled, n_components)
    gains = np.sum((scaled @ basis.T) ** 2, axis=0)
    return AffineSubspace(mean, basis.astype(np.float32), gains)


def projected_weights(
    rows: Float32[F32, "verts dims"], subspace: AffineSubspace
) -> Float32[F32, "verts pcs"]:
    """Return w_x of each vertex: its deviation from the mean along the components."""
    weights: F32 = np.matmul(rows - subspace.mean, subspace.basis.T)
    return weights


def squared_residuals(
    rows: Float32[F32, "verts dims"], subspace: AffineSubspace
) -> Float64[F64, " verts"]:
    """Return |x - x~|^2 of each vertex from the residual itself.

    [Sloan2003]_ section 4.2 has |x - x0|^2 minus the squared weights, of which float32 leaves
    nothing where the fit is good: the difference is wrong by 1e-7 of |x - x0|^2, the residual by
    that of its own square root.
    """
    residual: F32 = rows - subspace.mean
    residual -= np.matmul(np.matmul(residual, subspace.basis.T), subspace.basis)
    return row_energy(residual)


class AffineClusters:
    """State of the iteration: labels, subspaces, and the squared error of every vertex.

    Parameters
    ----------
    signal, weights
        One row a vertex, and the vertices' weights in the squared error.
    labels
        Cluster of each vertex, none of them empty; kept, and changed by the steps.
    n_clusters
        How many there are.
    depth
        Components that the model step finds in each cluster, of which `ranks` are used: more than
        those where their number is still open.
    row_space
        The principal component analysis.
    coherence
        Lets vertices pay for being far from their cluster on the mesh; None for the signal alone.

    Attributes
    ----------
    ranks
        Components asked for in each cluster; a cluster may have fewer.
    subspaces
        Mean and components in use.
    errors
        Squared residual of each vertex, without its weight.
    """

    def __init__(
        self,
        signal: Float32[F32, "verts dims"],
        weights: Float64[F64, " verts"],
        labels: Int32[I32, " verts"],
        n_clusters: int,
        *,
        depth: int,
        row_space: RowSpace,
        coherence: Coherence | None = None,
    ) -> None:
        self.signal, self.weights, self.labels = signal, weights, labels
        self.coherence = coherence
        energy = 0.0 if coherence is None else float(weights @ row_energy_by_chunks(signal))
        self._unit = float(np.sqrt(energy / weights.sum())) if energy > 0.0 else 1.0
        self.n_clusters, self.depth, self.row_space = n_clusters, depth, row_space
        self.ranks: I64 = np.zeros(n_clusters, dtype=np.int64)
        none = np.zeros(0, dtype=np.float32)
        self.subspaces = [AffineSubspace(none, none[:, None], np.zeros(0))] * n_clusters
        self.errors = np.zeros(len(signal))
        self._found = list(self.subspaces)
        # whose members are not those that its components were found for
        self._stale = np.ones(n_clusters, dtype=np.bool_)
        # whose subspace in use is not that of its components and rank
        self._uncut = np.ones(n_clusters, dtype=np.bool_)

    @property
    def squared_error(self) -> float:
        """Weighted squared error over all vertices: the objective."""
        return float(self.weights @ self.errors)

    @property
    def sizes(self) -> Int64[I64, " clusters"]:
        """Vertices of each cluster."""
        return np.bincount(self.labels, minlength=self.n_clusters)

    @property
    def gains(self) -> Sequence[F64]:
        """What every component found takes off its cluster's squared error."""
        return [subspace.gains for subspace in self._found]

    def copy(self) -> "AffineClusters":
        """Return a state of its own that shares the arrays that no step changes in place."""
        other = object.__new__(AffineClusters)
        other.__dict__.update(self.__dict__)
        for name in ("ranks", "labels", "subspaces", "errors", "_found", "_stale", "_uncut"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def deepen(self, depth: int) -> None:
        """Find more components from here on, in every cluster."""
        self.depth = depth
        self._stale[:] = True
        self.find_components()

    def find_components(self) -> None:
        """First half of the model step: mean and components of clusters with other members."""
        members = members_by_cluster(self.labels, self.n_clusters)

        def find(cluster: int) -> None:
            verts = members[cluster]
            if len(verts):
                self._found[cluster] = fit_subspace(
                    self.signal[verts], self.weights[verts], self.depth, self.row_space
                )

        map_in_order(find, np.flatnonzero(self._stale).tolist())
        self._uncut |= self._stale
        self._stale[:] = False

    def use(self, ranks: Int64[I64, " clusters"]) -> None:
        """Second half: use so many of the components, and take the errors anew."""
        self._uncut |= ranks != self.ranks
        self.ranks = ranks.copy()
        members = members_by_cluster(self.labels, self.n_clusters)

        def cut(cluster: int) -> None:
            verts = members[cluster]
            if len(verts):
                self.subspaces[cluster] = self._found[cluster].cut(int(ranks[cluster]))
                self.errors[verts] = squared_residuals(self.signal[verts], self.subspaces[cluster])

        map_in_order(cut, np.flatnonzero(self._uncut).tolist())
        self._uncut[:] = False

    def coherent_moves(self, fees: Float64[F64, " verts"] | None = None) -> CoherentMoves | None:
        """Return what vertices pay for their places now, fees included; None without coherence."""
        if self.coherence is None:
            return None
        errors = self.errors
        if fees is not None:
            errors = errors + fees * self._used()[self.labels]
        return CoherentMoves(self.coherence, self.labels, self.n_clusters, errors, self._unit)

    def _used(self) -> I64:
        return np.array([len(subspace.basis) for subspace in self.subspaces])

    def move(
        self,
        proposed: Int32[I32, " verts"],
        fees: Float64[F64, " verts"] | None = None,
        moves: CoherentMoves | None = None,
    ) -> int:
        """Move vertices to the proposed clusters where that really pays; return how many moved.

        Parameters
        ----------
        proposed
            A cluster for each vertex.
        fees
            Squared error that one component more must save each vertex; none when None.
        moves
            Of `coherent_moves`, with the same fees: lets no vertex go where it would pay more.
        """
        candidates = np.flatnonzero(proposed != self.labels)
        groups = members_by_cluster(proposed[candidates], self.n_clusters)
        used = self._used()

        def confirm(cluster: int) -> int:
            verts = candidates[groups[cluster]]
            residuals = squared_residuals(self.signal[verts], self.subspaces[cluster])
            more = 0.0
            if fees is not None:
                more = fees[verts] * (used[cluster] - used[self.labels[verts]])
            pays = residuals + more < self.errors[verts]
            if moves is not None:
                charge = 0.0 if fees is None else fees[verts] * used[cluster]
                pays &= moves.pays(verts, cluster, residuals + charge)
            movers = verts[pays]
            left.extend(np.unique(self.labels[movers]).tolist())
            self.labels[movers] = cluster
            self.errors[movers] = residuals[pays]
            if len(movers):
                left.append(cluster)
            return len(movers)

        left: list[int] = []
        n_moved = sum(map_in_order(confirm, range(self.n_clusters)))
        self._stale[left] = True
        return n_moved

    def fill_empty_clusters(self) -> None:
        """Give every empty cluster a part of the worst one, and that one's components."""
        for cluster, donor in refill_empty_clusters(
            self.signal, self.labels, self.errors, self.weights, self.n_clusters
        ):
            self.subspaces[cluster] = self.subspaces[donor]
            self._found[cluster] = self._found[donor]
            self.ranks[cluster] = self.ranks[donor]
            self._stale[[cluster, donor]] = True
