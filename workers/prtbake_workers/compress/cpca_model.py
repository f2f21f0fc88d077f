"""The result of clustered PCA."""

from dataclasses import dataclass, field

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32


@dataclass(frozen=True, kw_only=True)
class CpcaModel:
    """A signal as a cluster's mean plus weighted principal components.

    x~ = mean_c + sum_p w_xp component_cp ([Sloan2003]_ section 4).

    Attributes
    ----------
    means
        Mean signal of each cluster.
    components
        Orthonormal components of each cluster, strongest first; zero beyond its rank.  Their
        number is that asked for, or the largest rank where clusters may have more.
    weights
        Projected weights of each vertex; zero beyond its cluster's rank.
    labels
        Cluster of each vertex.
    ranks
        Components that each cluster really has.
    objective
        Squared error, weighted by the vertices' weights, after each step: one entry a clustering
        iteration, at first of the means only, and one when components join.
    initial_energy
        Squared norm of the signal with the same weights.
    squared_error_per_vertex
        Squared error of each vertex, without its weight.
    iterations, seed
        Steps of the objective before its last, and the seed of the first clusters.
    notes
        What was cut or left out, in words.
    trimmed
        Squared error, weighted, that columns held which were left out after the last step.
    """

    means: Float32[F32, "clusters dims"]
    components: Float32[F32, "clusters pcs dims"]
    weights: Float32[F32, "verts pcs"]
    labels: Int32[I32, " verts"]
    ranks: Int32[I32, " clusters"]
    objective: list[float]
    initial_energy: float
    squared_error_per_vertex: Float64[F64, " verts"]
    iterations: int
    seed: int
    notes: list[str] = field(default_factory=list)
    trimmed: float = 0.0

    @property
    def n_clusters(self) -> int:
        """Clusters, none of them empty."""
        return len(self.means)

    @property
    def nbytes(self) -> int:
        """Bytes of the float32 means, components and weights, without what only pads the arrays."""
        sizes = np.bincount(self.labels, minlength=self.n_clusters)
        return 4 * (self.means.size + int(self.ranks @ (sizes + self.means.shape[1])))

    @property
    def squared_error_ratio(self) -> float:
        """Squared error over squared norm, both weighted; 0 for a signal of zeros."""
        if self.initial_energy <= 0.0:
            return 0.0
        return (self.objective[-1] + self.trimmed) / self.initial_energy

    def reconstruct(self, verts: slice | None = None) -> Float32[F32, "part_verts dims"]:
        """Return the approximated signal of ``verts``, or of every vertex."""
        part = slice(None) if verts is None else verts
        labels, weights = self.labels[part], self.weights[part]
        signal = self.means[labels]
        for cluster in np.unique(labels):
            members = np.flatnonzero(labels == cluster)
            signal[members] += weights[members] @ self.components[cluster]
        return signal
