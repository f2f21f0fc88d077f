"""Re-classification of vertices by approximation error ([Tsai2006]_ section 5.2.3).

With orthonormal bases the error of vertex x in cluster c is ||Z_x||^2 - ||w_x,c||^2, and with the
light bases folded into the dual bases, F_c, the weights w_x,c = F_c uf(Z_x) of many vertices in
many clusters are one matrix product.

Most clusters need no product.  Vertex x of cluster c is uf(Z_x) = F_c^T w_x,c + r, so no cluster d
captures more of it than (||F_d F_c^T w_x,c|| + ||r||)^2: products of small matrices, of which
F_d F_c^T is shared by the whole cluster.  Only clusters that could capture more than c are tried.

The product proposes; the residual itself decides, and the vertex moves only when its error really
falls.  So neither rounding nor cancellation near zero error moves a vertex.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.compress.cluster_factors import ClusterFactors, squared_residuals
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.parallel import map_in_order
from prtbake_workers.compress.rows import Rows

# Relative rounding of the float32 bound: two products and a sum of squares, 1e-6 at the worst.
BOUND_SLACK = 1e-5
# Vertices that try the union of their possible clusters together.  Fewer try less in vain, 14 % of
# all pairs at the papers' settings where 7 % are possible; more keep the products efficient.
BLOCK_VERTS = 64

Pays = Callable[[I32, int, F64], B8]
"""From vertices, a cluster and their squared residuals there to whether they may move."""


class Moves(NamedTuple):
    """Vertices of one cluster that leave it, where they go, and their squared residuals there."""

    verts: Int32[I32, " movers"]
    labels: Int32[I32, " movers"]
    errors: Float64[F64, " movers"]


def reclassify(
    z: Rows,
    factors: Sequence[ClusterFactors],
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
    pays: Pays | None = None,
) -> int:
    """Move each vertex to the cluster that approximates it best; return how many moved.

    Parameters
    ----------
    z, factors
        Z_view of all vertices, (verts, r_view, coeffs), and the bases of all clusters.
    labels, errors
        The present cluster of each vertex and its squared residual there; both are changed in
        place for the vertices that move.
    pays
        Tells whether vertices may move to a cluster where their residual is lower; None lets all.
    """
    moves = better_clusters(z, factors, labels, errors, range(len(factors)), pays)
    return take_moves(moves, labels, errors)


def better_clusters(
    z: Rows,
    factors: Sequence[ClusterFactors],
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
    clusters: Iterable[int],
    pays: Pays | None = None,
) -> list[Moves]:
    """Return who leaves each of ``clusters``, by what `reclassify` takes; nobody moves yet.

    A cluster's movers depend on no other's, bit by bit: products are of its own vertices alone.
    """
    clusters = list(clusters)
    proposed = propose_clusters(z, factors, labels, errors, clusters)
    members = members_by_cluster(labels, len(factors))

    def confirm(cluster: int) -> Moves:
        verts = members[cluster]
        verts = verts[proposed[verts] != cluster]
        targets, residuals = proposed[verts], np.empty(len(verts))
        better = np.zeros(len(verts), dtype=np.bool_)
        for target in np.unique(targets).tolist():
            tried = np.flatnonzero(targets == target)
            own = verts[tried]
            residuals[tried] = squared_residuals(z[own], factors[target])
            better[tried] = residuals[tried] < errors[own]
            if pays is not None:
                better[tried] &= pays(own, target, residuals[tried])
        return Moves(verts[better], targets[better], residuals[better])

    return map_in_order(confirm, clusters)


def take_moves(
    moves: Iterable[Moves], labels: Int32[I32, " verts"], errors: Float64[F64, " verts"]
) -> int:
    """Change labels and errors of those who move, in place; return how many there are."""
    n_moved = 0
    for verts, targets, residuals in moves:
        labels[verts], errors[verts] = targets, residuals
        n_moved += len(verts)
    return n_moved


def propose_clusters(
    z: Rows,
    factors: Sequence[ClusterFactors],
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
    clusters: Iterable[int] | None = None,
) -> Int32[I32, " verts"]:
    """Return the cluster with the least error for each vertex, to float32.

    The present one stays where no other is better, and where it is none of ``clusters`` (all when
    None).
    """
    bases = stacked_bases(factors, z.shape[1])
    n_clusters, r_vert, _ = bases.shape
    stacked = bases.reshape(n_clusters * r_vert, -1)
    members = members_by_cluster(labels, n_clusters)
    proposed = labels.copy()

    def propose(cluster: int) -> None:
        verts = members[cluster]
        part = z[verts].reshape(len(verts), bases.shape[2])
        own = part @ bases[cluster].T
        captured = _energy(own[:, None])
        overlaps = bases[cluster] @ stacked.T
        reach = _energy((own @ overlaps).reshape(len(verts), n_clusters, r_vert))
        bound = (np.sqrt(reach) + np.sqrt(errors[verts, None])) ** 2
        possible = bound * (1.0 + BOUND_SLACK) > captured
        possible[:, cluster] = False
        # Vertices with about as many possible clusters mostly share them.
        order = np.argsort(np.count_nonzero(possible, axis=1), kind="stable")
        for start in range(0, len(verts), BLOCK_VERTS):
            block = order[start : start + BLOCK_VERTS]
            tried = part[block]
            best, best_captured = labels[verts[block]], captured[block, 0]
            for other in np.flatnonzero(possible[block].any(axis=0)):
                weights = tried @ bases[other].T
                score = _energy(weights[:, None])[:, 0]
                better = score > best_captured
                best[better] = other
                best_captured[better] = score[better]
            proposed[verts[block]] = best

    map_in_order(propose, range(n_clusters) if clusters is None else clusters)
    return proposed


def stacked_bases(
    factors: Sequence[ClusterFactors], r_view: int
) -> Float32[F32, "clusters r_vert r_view_coeffs"]:
    """Return the folded bases of all clusters, padded to one rank with rows of zeros."""
    r_vert = max(1, *(len(cluster.dual) for cluster in factors))
    n_coeffs = len(factors[0].light)
    bases = np.zeros((len(factors), r_vert, r_view * n_coeffs), dtype=np.float32)
    for cluster, basis in zip(factors, bases, strict=True):
        basis[: len(cluster.dual)] = cluster.folded(r_view)
    return bases


def _energy(
    weights: Float32[F32, "verts clusters r_vert"],
) -> Float64[F64, "verts clusters"]:
    energy = np.einsum("vcr,vcr->vc", weights, weights, dtype=np.float64)
    return np.asarray(energy, dtype=np.float64)
