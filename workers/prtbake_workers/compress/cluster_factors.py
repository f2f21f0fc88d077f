"""Light and vertex factors of one cluster, fitted by alternating least squares.

All of it works on Z_view = T x_1 U_view^T ([Tsai2006]_ eq. 14) of the cluster's own vertices,
held as (verts, r_view, coeffs); where transfer has colour channels, the view rows of one lie under
those of the other, and r_view counts them all.  A vertex's weight a_x enters as sqrt(a_x) on the
small matrices, never on the data, so bases serve the unweighted vertices as they are.
"""

from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.energy import row_chunks, row_energy
from prtbake_workers.compress.gram_eigh import (
    leading_eigenvectors,
    leading_row_space,
    nearer_row_space,
)

View = Float32[F32, "verts r_view coeffs"]
# Rows of this many float32 products are summed before they join the float64 Gram matrix.
GRAM_CHUNK_BYTES = 8 << 20


class ClusterFactors(NamedTuple):
    """Bases of one cluster, at its true ranks.

    Attributes
    ----------
    light
        U_light,c with orthonormal columns.
    dual
        V_c with orthonormal rows; a row unfolds to (r_view, r_light), light last.
    """

    light: Float32[F32, "coeffs r_light"]
    dual: Float32[F32, "r_vert r_view_light"]

    def folded(self, r_view: int) -> Float32[F32, "r_vert r_view_coeffs"]:
        """Return V_c with U_light,c^T folded in, so that w_x is one product with uf(Z_x)."""
        n_coeffs, r_light = self.light.shape
        rows = self.dual.reshape(len(self.dual) * r_view, r_light) @ self.light.T
        return rows.reshape(len(self.dual), r_view * n_coeffs)


def rank_zero(n_coeffs: int) -> ClusterFactors:
    """Return the factors of a cluster without vertices."""
    return ClusterFactors(np.zeros((n_coeffs, 0), np.float32), np.zeros((0, 0), np.float32))


def initial_light_basis(
    z: View, root_weights: Float64[F64, " verts"], rank: int
) -> Float32[F32, "coeffs r_light"]:
    """Return the leading eigenvectors of the light mode's Gram matrix: the start of the sweeps."""
    n_coeffs = z.shape[2]
    gram = np.zeros((n_coeffs, n_coeffs))
    for chunk in row_chunks(z.reshape(len(z), -1), GRAM_CHUNK_BYTES):
        scale = root_weights[chunk].astype(np.float32)[:, None, None]
        rows = (z[chunk] * scale).reshape(-1, n_coeffs)
        gram += rows.T @ rows
    return leading_eigenvectors(gram, rank)[1].astype(np.float32, order="C")


def project_light(
    z: View, light: Float32[F32, "coeffs r_light"]
) -> Float32[F32, "verts r_view_light"]:
    """Return uf(Z_x U_light,c) of each vertex, a row each."""
    n_verts, r_view, n_coeffs = z.shape
    rows = z.reshape(n_verts * r_view, n_coeffs) @ light
    return rows.reshape(n_verts, r_view * light.shape[1])


def projected_weights(z: View, factors: ClusterFactors) -> Float32[F32, "verts r_vert"]:
    """Return w_x = V_c uf(Z_x U_light,c) of each vertex ([Tsai2006]_ eq. 17)."""
    return project_light(z, factors.light) @ factors.dual.T


def vertex_basis(
    weights: Float32[F32, "verts r_vert"], root_weights: Float64[F64, " verts"]
) -> Float64[F64, "verts kept"]:
    """Return an orthonormal basis of the columns of the projected weights: U_vert,c.

    Householder QR: where the columns are dependent it adds directions, which costs nothing.
    """
    return np.asarray(np.linalg.qr(root_weights[:, None] * weights)[0], dtype=np.float64)


def light_step(
    z: View,
    u_vert: Float64[F64, "verts kept"],
    root_weights: Float64[F64, " verts"],
    rank: int,
    start: Float32[F32, "coeffs given"] | None = None,
) -> Float32[F32, "coeffs r_light"]:
    """Return the best U_light,c for a given U_vert,c, or a better one than ``start``."""
    n_verts, r_view, n_coeffs = z.shape
    mixing = (u_vert * root_weights[:, None]).T.astype(np.float32, order="C")
    mixed = mixing @ z.reshape(n_verts, r_view * n_coeffs)
    rows = mixed.reshape(-1, n_coeffs).astype(np.float64)
    given = None if start is None else start.T.astype(np.float64)
    # one layout wherever bases come from: another makes other bits of a product
    return _row_space(rows, rank, given).T.astype(np.float32, order="C")


def vertex_step(
    projected: Float32[F32, "verts r_view_light"],
    root_weights: Float64[F64, " verts"],
    rank: int,
    u_vert: Float64[F64, "verts kept"] | None = None,
) -> Float32[F32, "r_vert r_view_light"]:
    """Return the best V_c for a given U_light,c, or a better one than goes with ``u_vert``.

    V_c is the leading row space of ``projected``, the cluster's ``project_light``: eq. (16) of
    [Tsai2006]_ without its division by zero where the cluster has lower rank than asked for.
    """
    rows = projected.astype(np.float64)
    rows *= root_weights[:, None]
    start = None if u_vert is None else np.linalg.qr(rows.T @ u_vert)[0].T
    return _row_space(rows, rank, start).astype(np.float32, order="C")


def _row_space(
    rows: Float64[F64, "rows dims"], rank: int, start: Float64[F64, "given dims"] | None
) -> Float64[F64, "kept dims"]:
    """Take one iteration from a start of full rank, which the sweeps repeat; all of it without."""
    if start is None or len(start) < rank:
        return leading_row_space(rows, rank)
    return nearer_row_space(rows, start)


def fit_cluster(
    z: View,
    root_weights: Float64[F64, " verts"],
    r_light: int,
    r_vert: int,
    *,
    start: ClusterFactors | None,
    sweeps: int,
) -> tuple[ClusterFactors, Float64[F64, " verts"]]:
    """Return the factors after so many sweeps from ``start``, and the squared residuals.

    A sweep is a light step and a vertex step; neither can raise the weighted squared error of
    ``start``.  Without one, the light mode's own leading vectors are the start, and each step takes
    the best basis; with one, each brings its basis one iteration nearer to the best.
    """
    n_verts, r_view, n_coeffs = z.shape
    if start is None:
        light = initial_light_basis(z, root_weights, r_light)
        projected = project_light(z, light)
        dual = vertex_step(projected, root_weights, r_vert)
        weights = projected @ dual.T
    else:
        light, dual = start
        weights = z.reshape(n_verts, r_view * n_coeffs) @ start.folded(r_view).T
    for _ in range(sweeps):
        u_vert = vertex_basis(weights, root_weights)
        light = light_step(z, u_vert, root_weights, r_light, light if start else None)
        projected = project_light(z, light)
        dual = vertex_step(projected, root_weights, r_vert, u_vert if start else None)
        weights = projected @ dual.T
    factors = ClusterFactors(light, dual)
    return factors, squared_residuals(z, factors, projected)


def squared_residuals(
    z: View,
    factors: ClusterFactors,
    projected: Float32[F32, "verts r_view_light"] | None = None,
) -> Float64[F64, " verts"]:
    """Return ||Z_x - Z~_x||^2 of each vertex from the residual itself: exact near zero.

    ``projected`` is ``project_light`` of the same data, where the caller has it.
    """
    n_verts, r_view, n_coeffs = z.shape
    if projected is None:
        projected = project_light(z, factors.light)
    energy = np.empty(n_verts)
    for chunk in row_chunks(z.reshape(n_verts, r_view * n_coeffs)):
        core = (projected[chunk] @ factors.dual.T) @ factors.dual
        rows: F32 = np.matmul(
            core.reshape(len(core) * r_view, factors.light.shape[1]), factors.light.T
        )
        np.subtract(z[chunk].reshape(-1, n_coeffs), rows, out=rows)
        energy[chunk] = row_energy(rows.reshape(len(core), r_view * n_coeffs))
    return energy
