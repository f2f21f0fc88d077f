"""The result of clustered tensor approximation."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.compress.cluster_factors import ClusterFactors


class CtaRanks(NamedTuple):
    """Reduced ranks of the three modes: R_view, R_light and R_vert of [Tsai2006]_."""

    view: int
    light: int
    vert: int


@dataclass(frozen=True, kw_only=True)
class CtaModel:
    """A transfer tensor as one view basis, and two bases for each cluster of vertices.

    T_x ~ U_view uf^-1(V_c^T w_x) U_light,c^T ([Tsai2006]_ eq. 18), with ``view_basis`` U_view,
    ``light_bases`` U_light,c, ``dual_bases`` V_c and ``weights`` w_x.  Colour channels share all
    but the dual bases, which hold the view rows of one channel after those of the other.

    Attributes
    ----------
    view_basis
        Orthonormal columns, shared by all clusters.
    light_bases
        Orthonormal columns of each cluster; zero beyond its rank.
    dual_bases
        Orthonormal rows of each cluster, zero beyond its rank.  A row unfolds to
        (channels, R_view, R_light), light last.
    weights
        Projected weights of each vertex; zero beyond its cluster's rank.
    labels
        Cluster of each vertex.
    ranks
        True (view, light, vert) ranks of each cluster; view is that of one channel.
    objective
        Squared error, weighted by the vertices' weights, after each model step.
    initial_energy
        Squared norm of the tensor with the same weights.
    squared_error_per_vertex
        Squared error of each vertex, without its weight.
    iterations, seed
        Model steps, and the seed of the initial clustering.
    n_channels
        Channels of the tensor: row c * terms + k of a vertex is term k of channel c.
    notes
        What was cut or left out, in words.
    trimmed
        Squared error, weighted, that columns held which were left out after the last step.
    """

    view_basis: Float32[F32, "terms r_view"]
    light_bases: Float32[F32, "clusters coeffs r_light"]
    dual_bases: Float32[F32, "clusters r_vert channel_view_light"]
    weights: Float32[F32, "verts r_vert"]
    labels: Int32[I32, " verts"]
    ranks: Int32[I32, "clusters 3"]
    objective: list[float]
    initial_energy: float
    squared_error_per_vertex: Float64[F64, " verts"]
    iterations: int
    seed: int
    n_channels: int = 1
    notes: list[str] = field(default_factory=list)
    trimmed: float = 0.0

    @property
    def n_clusters(self) -> int:
        """Clusters, none of them empty."""
        return len(self.light_bases)

    @property
    def nbytes(self) -> int:
        """Bytes of the float32 factors, without what only pads the arrays."""
        sizes = np.bincount(self.labels, minlength=self.n_clusters)
        view, light, vert = self.ranks.T.astype(np.int64)
        rows = self.n_channels * view * light + sizes
        floats = self.light_bases.shape[1] * light + rows * vert
        return 4 * (self.view_basis.size + int(floats.sum()))

    @property
    def squared_error_ratio(self) -> float:
        """Squared error over squared norm, both weighted; 0 for a tensor of zeros."""
        if self.initial_energy <= 0.0:
            return 0.0
        return (self.objective[-1] + self.trimmed) / self.initial_energy

    def reconstruct(self, verts: slice | None = None) -> Float32[F32, "part_verts rows coeffs"]:
        """Return the approximated transfer of ``verts``, or of every vertex."""
        part = slice(None) if verts is None else verts
        labels, weights = self.labels[part], self.weights[part]
        n_terms, r_view = self.view_basis.shape
        n_coeffs, r_light = self.light_bases.shape[1:]
        transfer = np.empty((len(labels), self.n_channels * n_terms, n_coeffs), dtype=np.float32)
        for cluster in np.unique(labels):
            members = np.flatnonzero(labels == cluster)
            core = (weights[members] @ self.dual_bases[cluster]).reshape(-1, r_view, r_light)
            terms = (self.view_basis @ core) @ self.light_bases[cluster].T
            transfer[members] = terms.reshape(len(members), -1, n_coeffs)
        return transfer


def padded(
    factors: Sequence[ClusterFactors], n_rows: int, width: CtaRanks
) -> tuple[Float32[F32, "clusters coeffs r_light"], Float32[F32, "clusters r_vert rows_light"]]:
    """Join the bases of all clusters, with zeros beyond their ranks, as a model holds them.

    ``n_rows`` counts the view rows of all channels, ``width`` is as wide as the arrays are to be.
    """
    _, r_light, r_vert = width
    light = np.zeros((len(factors), len(factors[0].light), r_light), dtype=np.float32)
    dual = np.zeros((len(factors), r_vert, n_rows, r_light), dtype=np.float32)
    for index, own in enumerate(factors):
        own_light, own_vert = own.light.shape[1], len(own.dual)
        light[index, :, :own_light] = own.light
        dual[index, :own_vert, :, :own_light] = own.dual.reshape(own_vert, n_rows, own_light)
    return light, dual.reshape(len(factors), r_vert, n_rows * r_light)


def unpadded(model: CtaModel) -> list[ClusterFactors]:
    """Give the bases of each cluster at its own light and vertex ranks."""
    n_rows, width = model.n_channels * model.view_basis.shape[1], model.light_bases.shape[2]
    found = []
    for light, dual, ranks in zip(model.light_bases, model.dual_bases, model.ranks, strict=True):
        _, r_light, r_vert = ranks.tolist()
        rows = dual[:r_vert].reshape(r_vert, n_rows, width)[:, :, :r_light]
        found.append(
            ClusterFactors(
                np.ascontiguousarray(light[:, :r_light]),
                np.ascontiguousarray(rows.reshape(r_vert, n_rows * r_light)),
            )
        )
    return found
