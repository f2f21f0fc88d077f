"""The view basis that all clusters share, and the tensor projected on it.

Colour channels share it as well: to the view mode each channel of a vertex is a vertex of its own.
"""

from collections.abc import Sequence

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64
from prtbake_workers.compress.cluster_factors import ClusterFactors
from prtbake_workers.compress.energy import row_chunks, row_energy
from prtbake_workers.compress.gram_eigh import leading_eigenvectors
from prtbake_workers.compress.parallel import map_in_order

Transfer = Float32[F32, "verts terms coeffs"]


def initial_view_basis(
    transfer: Transfer, weights: Float64[F64, " verts"], rank: int
) -> Float32[F32, "terms r_view"]:
    """Return the leading left singular vectors of the mode-1 unfolding ([Tsai2006]_ 5.2.2)."""
    return leading_eigenvectors(_view_gram(transfer, weights), rank)[1].astype(np.float32)


def view_energies(transfer: Transfer, weights: Float64[F64, " verts"]) -> Float64[F64, " terms"]:
    """Return the squared singular values of the mode-1 unfolding, falling: the view's spectrum."""
    energies = np.linalg.eigvalsh(_view_gram(transfer, weights))[::-1]
    return np.asarray(np.maximum(energies, 0.0))


def _view_gram(transfer: Transfer, weights: Float64[F64, " verts"]) -> Float64[F64, "terms terms"]:
    """Sum T_x T_x^T over the vertices in float64."""
    n_terms = transfer.shape[1]

    def gram_of(chunk: slice) -> F64:
        part = transfer[chunk]
        per_vertex = (part @ part.transpose(0, 2, 1)).reshape(len(part), -1)
        weighted = weights[chunk] @ per_vertex.astype(np.float64)
        return np.asarray(weighted.reshape(n_terms, n_terms))

    chunks = row_chunks(transfer.reshape(len(transfer), -1))
    return np.asarray(sum(map_in_order(gram_of, chunks), np.zeros((n_terms, n_terms))))


def updated_view_basis(
    transfer: Float32[F32, "verts rows coeffs"],
    members: Sequence[I32],
    vertex_bases: Sequence[F64],
    factors: Sequence[ClusterFactors],
    root_weights: Float64[F64, " verts"],
    rank: int,
    n_channels: int = 1,
) -> Float32[F32, "terms r_view"]:
    """Return the best U_view for given light and vertex bases ([Tsai2006]_ eq. 19).

    The Gram matrix of uf_1(Z_light,vert) is summed over clusters and channels in float64; a row of
    ``transfer`` is a term, or a term of one channel.
    """
    n_rows, n_coeffs = transfer.shape[1:]
    n_terms = n_rows // n_channels

    def gram_of(index: int) -> F64:
        verts, u_vert, cluster = members[index], vertex_bases[index], factors[index]
        if len(verts) == 0:
            return np.zeros((n_terms, n_terms))
        mixing = (u_vert * root_weights[verts, None]).T.astype(np.float32)
        mixed = mixing @ transfer[verts].reshape(len(verts), n_rows * n_coeffs)
        core = (mixed.reshape(-1, n_coeffs) @ cluster.light).astype(np.float64)
        r_vert, r_light = n_channels * mixing.shape[0], cluster.light.shape[1]
        core = core.reshape(r_vert, n_terms, r_light).transpose(1, 0, 2)
        unfolded = core.reshape(n_terms, r_vert * r_light)
        return np.asarray(unfolded @ unfolded.T)

    gram = sum(map_in_order(gram_of, range(len(members))), np.zeros((n_terms, n_terms)))
    return leading_eigenvectors(gram, rank)[1].astype(np.float32)


def project_view(
    transfer: Transfer,
    view_basis: Float32[F32, "terms r_view"],
    z: Float32[F32, "verts r_view coeffs"],
) -> Float64[F64, " verts"]:
    """Write Z_view = T x_1 U_view^T into ``z``; return what it leaves out of each vertex.

    [Tsai2006]_ eq. (14).  The energy left out is that of the residual T_x - U_view Z_x, not a
    difference of energies, and is orthogonal to anything that is fitted to Z_x.
    """
    left_out = np.empty(len(transfer))

    def project(chunk: slice) -> None:
        part = transfer[chunk]
        np.matmul(view_basis.T, part, out=z[chunk])
        residual = part - view_basis @ z[chunk]
        left_out[chunk] = row_energy(residual.reshape(len(part), -1))

    map_in_order(project, row_chunks(transfer.reshape(len(transfer), -1)))
    return left_out
