"""Re-classification of vertices by approximation error ([Tsai2006]_ section 5.2.3).

With orthonormal bases the error of vertex x in cluster c is ||Z_x||^2 - ||w_x,c||^2.  Light bases
are folded into the dual bases, so the weights of a block of vertices in all clusters are one
matrix product.  The product proposes; the residual itself decides, and the vertex moves only when
its error really falls.  So neither rounding nor cancellation near zero error moves a vertex.
"""

from collections.abc import Sequence

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.compress.cluster_factors import ClusterFactors, squared_residuals
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.energy import row_chunks

# The classes' product is as wide as all clusters' ranks together; so many vertices at a time keep
# it at some 20 MiB while the product still runs at full speed.
CHUNK_BYTES = 40 << 20


def propose_clusters(
    z: Float32[F32, "verts r_view coeffs"], factors: Sequence[ClusterFactors]
) -> Int32[I32, " verts"]:
    """Return the cluster with the least approximation error for each vertex, to float32.

    Among scores that are equal to the bit the lowest number wins.
    """
    n_verts, r_view, n_coeffs = z.shape
    rows = z.reshape(n_verts, r_view * n_coeffs)
    r_vert = max(1, *(len(cluster.dual) for cluster in factors))
    # Zero rows pad the clusters to one rank, so that their energies are sums along one axis.
    bases = np.zeros((len(factors), r_vert, r_view * n_coeffs), dtype=np.float32)
    for cluster, basis in zip(factors, bases, strict=True):
        basis[: len(cluster.dual)] = cluster.folded(r_view)
    stacked = bases.reshape(len(factors) * r_vert, r_view * n_coeffs)
    proposed = np.empty(n_verts, dtype=np.int32)
    for chunk in row_chunks(rows, CHUNK_BYTES):
        weights = (rows[chunk] @ stacked.T).reshape(-1, len(factors), r_vert)
        captured = np.einsum("vcr,vcr->vc", weights, weights, dtype=np.float64)
        proposed[chunk] = np.argmax(captured, axis=1)
    return proposed


def reclassify(
    z: Float32[F32, "verts r_view coeffs"],
    factors: Sequence[ClusterFactors],
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
) -> int:
    """Move each vertex to the cluster that approximates it best; return how many moved.

    Parameters
    ----------
    z, factors
        Z_view of all vertices and the bases of all clusters.
    labels, errors
        The present cluster of each vertex and its squared residual there; both are changed in
        place for the vertices that move.
    """
    proposed = propose_clusters(z, factors)
    candidates = np.flatnonzero(proposed != labels)
    n_moved = 0
    for cluster, group in enumerate(members_by_cluster(proposed[candidates], len(factors))):
        if len(group) == 0:
            continue
        verts = candidates[group]
        residuals = squared_residuals(z[verts], factors[cluster])
        better = residuals < errors[verts]
        movers = verts[better]
        labels[movers] = cluster
        errors[movers] = residuals[better]
        n_moved += len(movers)
    return n_moved
