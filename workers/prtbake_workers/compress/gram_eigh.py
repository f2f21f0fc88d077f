"""Leading singular vectors through the eigen-decomposition of a small Gram matrix.

For a matrix with one short side this is several times faster than an SVD.  It squares the
condition number, so Gram matrices are accumulated in float64, directions below the float32 noise
of the data are not counted as rank, and orthogonality is checked.
"""

from collections.abc import Callable

import numpy as np
import scipy.linalg

from prtbake_workers.arrays import F64, Float64

Eigenvectors = Callable[[F64, int], tuple[F64, F64]]
"""Gives the n largest eigenvalues of a Gram matrix, falling, and their vectors as columns."""

# Directions whose share of the leading one's energy is below this are rank-deficient: float32
# input holds each of them to 1e-7 in amplitude, 1e-14 in energy.  Leaving one out costs at most
# this share of the energy.
RANK_TOLERANCE = 1e-12
# A larger deviation of B B^T from the identity is removed by one QR factorisation.
ORTHOGONALITY_TOLERANCE = 1e-9


def leading_eigenvectors(
    gram: Float64[F64, "dims dims"], n: int
) -> tuple[Float64[F64, " kept"], Float64[F64, "dims kept"]]:
    """Return the ``n`` largest eigenvalues of a symmetric matrix, falling, and their vectors.

    ``n`` above the size of the matrix means all of them.
    """
    size = len(gram)
    n = min(n, size)
    try:
        values, vectors = scipy.linalg.eigh(
            gram, subset_by_index=(size - n, size - 1), driver="evx", check_finite=False
        )
    except np.linalg.LinAlgError:
        # Inverse iteration can fail on tightly clustered eigenvalues; the full solver cannot.
        values, vectors = (part[..., size - n :] for part in np.linalg.eigh(gram))
    vectors = orthonormal_rows(np.ascontiguousarray(vectors[:, ::-1].T)).T
    return np.asarray(values[::-1], dtype=np.float64), vectors


def orthonormal_rows(rows: Float64[F64, "kept dims"]) -> Float64[F64, "kept dims"]:
    """Return ``rows``, orthonormalised once more where they are not orthonormal enough."""
    deviation = np.abs(rows @ rows.T - np.eye(len(rows))).max(initial=0.0)
    if deviation <= ORTHOGONALITY_TOLERANCE:
        return rows
    q, r = np.linalg.qr(rows.T)
    signs = np.where(np.diag(r) < 0.0, -1.0, 1.0)
    return np.asarray((q * signs).T, dtype=np.float64)


def leading_row_space(matrix: Float64[F64, "rows dims"], rank: int) -> Float64[F64, "kept dims"]:
    """Return an orthonormal basis of the ``rank`` leading right singular vectors, as rows.

    The Gram matrix of the shorter side is decomposed; from that of the rows, eigenvectors E with
    values lambda give the right singular vectors E^T M / sqrt(lambda).

    Parameters
    ----------
    matrix
        M, any shape, in float64.
    rank
        How many to keep; fewer come back where M has lower rank (``RANK_TOLERANCE``), none for a
        matrix of zeros.
    """
    return row_space(matrix, rank, leading_eigenvectors)


def row_space(
    matrix: Float64[F64, "rows dims"], rank: int, eigenvectors: Eigenvectors
) -> Float64[F64, "kept dims"]:
    """Return what `leading_row_space` does, with a decomposition of Gram matrices of one's own."""
    n_rows, n_dims = matrix.shape
    if 0 in matrix.shape:
        return np.zeros((0, n_dims))
    wide = n_rows < n_dims
    gram = matrix @ matrix.T if wide else matrix.T @ matrix
    values, vectors = eigenvectors(gram, min(rank, n_rows, n_dims))
    kept = int(np.count_nonzero(values > RANK_TOLERANCE * values.max(initial=0.0)))
    values, vectors = values[:kept], vectors[:, :kept]
    if not wide:
        return np.ascontiguousarray(vectors.T)
    return orthonormal_rows(vectors.T @ matrix / np.sqrt(values)[:, None])


def nearer_row_space(
    matrix: Float64[F64, "rows dims"], start: Float64[F64, "given dims"]
) -> Float64[F64, "kept dims"]:
    """Bring an orthonormal basis nearer to the leading right singular vectors, by one iteration.

    With the orthonormal basis Q of the columns of ``M start^T`` the result spans the rows of
    ``Q^T M``: an orthogonal iteration of ``M^T M``, without that matrix.  It holds no less of M
    than ``start`` did, as ``|Q^T M| >= |Q^T M start^T| = |M start^T|``.

    Parameters
    ----------
    matrix
        M, any shape, in float64.
    start
        Orthonormal rows.  The result has as many, or those of M where M has fewer; directions
        that M lacks are arbitrary.
    """
    q = np.linalg.qr(matrix @ start.T)[0]
    return np.ascontiguousarray(np.linalg.qr((q.T @ matrix).T)[0].T)
