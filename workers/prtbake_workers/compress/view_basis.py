"""The view basis that all clusters share, and the tensor projected on it.

Colour channels share it as well: to the view mode each channel of a vertex is a vertex of its own.
A row of transfer is a term, or with channels a term of one of them: row c * terms + k.
"""

from collections.abc import Iterable
from math import prod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.cluster_factors import ClusterFactors
from prtbake_workers.compress.energy import CHUNK_BYTES, row_chunks, row_energy
from prtbake_workers.compress.gram_eigh import leading_eigenvectors
from prtbake_workers.compress.parallel import map_in_order
from prtbake_workers.compress.rows import Rows


def initial_view_basis(
    transfer: Rows, weights: Float64[F64, " verts"], rank: int, n_channels: int = 1
) -> Float32[F32, "terms r_view"]:
    """Return the leading left singular vectors of the mode-1 unfolding ([Tsai2006]_ 5.2.2)."""
    gram = _view_gram(transfer, weights, n_channels)
    return leading_eigenvectors(gram, rank)[1].astype(np.float32, order="C")


def view_energies(
    transfer: Rows, weights: Float64[F64, " verts"], n_channels: int = 1
) -> Float64[F64, " terms"]:
    """Return the squared singular values of the mode-1 unfolding, falling: the view's spectrum."""
    energies = np.linalg.eigvalsh(_view_gram(transfer, weights, n_channels))[::-1]
    return np.asarray(np.maximum(energies, 0.0))


def _view_gram(
    transfer: Rows, weights: Float64[F64, " verts"], n_channels: int
) -> Float64[F64, "terms terms"]:
    """Sum T_x T_x^T over the vertices and their channels in float64."""
    n_rows, n_coeffs = transfer.shape[1:]
    n_terms = n_rows // n_channels

    def gram_of(chunk: slice) -> F64:
        part = transfer[chunk].reshape(-1, n_terms, n_coeffs)
        per_vertex = (part @ part.transpose(0, 2, 1)).reshape(len(part), -1)
        weighted = np.repeat(weights[chunk], n_channels) @ per_vertex.astype(np.float64)
        return np.asarray(weighted.reshape(n_terms, n_terms))

    grams = map_in_order(gram_of, row_chunks(transfer))
    return np.asarray(sum(grams, np.zeros((n_terms, n_terms))))


def view_gram_of_cluster(
    transfer: Float32[F32, "members rows coeffs"],
    vertex_basis: Float64[F64, "members kept"],
    factors: ClusterFactors,
    root_weights: Float64[F64, " members"],
    n_channels: int = 1,
) -> Float64[F64, "terms terms"]:
    """Return one cluster's share of the Gram matrix of uf_1(Z_light,vert), summed over channels."""
    n_verts, n_rows, n_coeffs = transfer.shape
    n_terms = n_rows // n_channels
    if n_verts == 0:
        return np.zeros((n_terms, n_terms))
    mixing = (vertex_basis * root_weights[:, None]).T.astype(np.float32, order="C")
    mixed = mixing @ transfer.reshape(n_verts, n_rows * n_coeffs)
    core = (mixed.reshape(-1, n_coeffs) @ factors.light).astype(np.float64)
    r_vert, r_light = n_channels * mixing.shape[0], factors.light.shape[1]
    core = core.reshape(r_vert, n_terms, r_light).transpose(1, 0, 2)
    unfolded = core.reshape(n_terms, r_vert * r_light)
    return np.asarray(unfolded @ unfolded.T)


def view_basis_of_grams(
    grams: Iterable[Float64[F64, "terms terms"]], rank: int
) -> Float32[F32, "terms r_view"]:
    """Return the best U_view for all clusters' light and vertex bases ([Tsai2006]_ eq. 19)."""
    first, *others = grams
    return leading_eigenvectors(sum(others, first), rank)[1].astype(np.float32, order="C")


def project_view(
    transfer: Rows,
    view_basis: Float32[F32, "terms r_view"],
    z: Float32[F32, "verts channel_view coeffs"] | None,
    n_channels: int = 1,
) -> Float64[F64, " verts"]:
    """Write Z_view = T x_1 U_view^T into ``z``, if any; return what it leaves out of each vertex.

    [Tsai2006]_ eq. (14).  The energy left out is that of the residual T_x - U_view Z_x, not a
    difference of energies, and is orthogonal to anything that is fitted to Z_x.
    """
    left_out = np.empty(len(transfer))

    def project(chunk: slice) -> None:
        part, seen = _projected(transfer[chunk], view_basis, n_channels)
        if z is not None:
            z[chunk] = seen.reshape(z[chunk].shape)
        energy = row_energy((part - view_basis @ seen).reshape(len(part), -1))
        left_out[chunk] = energy.reshape(-1, n_channels).sum(axis=1)

    map_in_order(project, row_chunks(transfer))
    return left_out


class ProjectedRows:
    """Z_view of transfer that does not lie in memory: projected anew whenever it is read.

    Every vertex is a product of its own, so its bits do not depend on what is read beside it.
    """

    def __init__(
        self, transfer: Rows, view_basis: Float32[F32, "terms r_view"], n_channels: int = 1
    ) -> None:
        n_verts, _, n_coeffs = transfer.shape
        self.transfer, self.view_basis, self.n_channels = transfer, view_basis, n_channels
        self.shape = (n_verts, n_channels * view_basis.shape[1], n_coeffs)
        self.nbytes = 4 * n_verts * self.shape[1] * n_coeffs

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(
        self, verts: slice | NDArray[Any], /
    ) -> Float32[F32, "verts channel_view coeffs"]:
        """Return the projected rows of some vertices."""
        if isinstance(verts, slice):
            verts = np.arange(*verts.indices(len(self)))
        z = np.empty((len(verts), *self.shape[1:]), dtype=np.float32)
        step = max(1, CHUNK_BYTES // (4 * prod(self.transfer.shape[1:])))
        for start in range(0, len(verts), step):
            block = slice(start, start + step)
            _, seen = _projected(self.transfer[verts[block]], self.view_basis, self.n_channels)
            z[block] = seen.reshape(z[block].shape)
        return z


def _projected(part: NDArray[Any], view_basis: F32, n_channels: int) -> tuple[F32, F32]:
    """Cut rows by channel, (verts * channels, terms, coeffs), and project them on the basis."""
    part = part.reshape(-1, part.shape[1] // n_channels, part.shape[2])
    return part, np.matmul(view_basis.T, part)
