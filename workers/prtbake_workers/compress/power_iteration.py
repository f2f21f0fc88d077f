"""Leading singular vectors by power iteration, one after the other ([Miandji2011]_ appendix).

A back end beside `gram_eigh`: v <- A v / |A v| with the Gram matrix A until v stays, then the
matrix without that direction.  It needs products only, and no more of them than there are vectors
asked for; where singular values lie close together it needs many.

What departs from the paper: the test is |A v - lambda v|, not the change of v, so that any vector
of a repeated singular value is accepted at once.  The direction is taken out of A from both sides,
(I - v v^T) A (I - v v^T), which is F <- F - (F v) v^T on the matrix itself and right for any v; so
a vector that has not converged, between close singular values, leaves the rest of them to the next
one.  In the end a decomposition within the vectors found sorts them.
"""

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.compress.gram_eigh import RANK_TOLERANCE, row_space

MOST_ITERATIONS = 1000
# |A v - lambda v| over lambda.  The energy that v misses is at most this share of lambda.
CONVERGED = 1e-9
# Start vectors are drawn: none is orthogonal to what it should find but by chance.
START_SEED = 2011


def leading_eigenvectors(
    gram: Float64[F64, "dims dims"], n: int
) -> tuple[Float64[F64, " kept"], Float64[F64, "dims kept"]]:
    """Return the ``n`` largest eigenvalues of a symmetric matrix >= 0, falling, and their vectors.

    Fewer come back where the others are below ``RANK_TOLERANCE`` of the largest; ``n`` above the
    size of the matrix means all.  The same matrix gives the same bytes.
    """
    size = len(gram)
    rng = np.random.default_rng(START_SEED)
    rest = gram.copy()
    found = np.zeros((0, size))
    largest = 0.0
    for _ in range(min(n, size)):
        # no eigenvalue is larger than their sum
        if np.trace(rest) <= RANK_TOLERANCE * largest:
            break
        vector = _without(rng.standard_normal(size), found)
        vector, value = _dominant(rest, vector)
        largest = max(largest, value)
        if value <= RANK_TOLERANCE * largest:
            break
        # rounding leaves something of the stronger ones
        vector = _without(vector, found)
        found = np.vstack([found, vector])
        image = rest @ vector
        rest -= np.outer(vector, image) + np.outer(image - (vector @ image) * vector, vector)
    values, turn = np.linalg.eigh(found @ gram @ found.T)
    return values[::-1], np.ascontiguousarray((turn[:, ::-1].T @ found).T)


def leading_row_space(matrix: Float64[F64, "rows dims"], rank: int) -> Float64[F64, "kept dims"]:
    """Return what `gram_eigh.leading_row_space` does, by power iteration."""
    return row_space(matrix, rank, leading_eigenvectors)


def _dominant(
    matrix: Float64[F64, "dims dims"], start: Float64[F64, " dims"]
) -> tuple[Float64[F64, " dims"], float]:
    """Return a vector of the largest eigenvalue, and the value; 0 for a matrix of zeros."""
    vector, value = start, 0.0
    for _ in range(MOST_ITERATIONS):
        image = matrix @ vector
        size = float(np.linalg.norm(image))
        if size == 0.0:
            return vector, 0.0
        value = float(vector @ image)
        if np.linalg.norm(image - value * vector) <= CONVERGED * value:
            break
        vector = image / size
    return vector, value


def _without(
    vector: Float64[F64, " dims"], found: Float64[F64, "kept dims"]
) -> Float64[F64, " dims"]:
    """Return the unit vector that is left of ``vector`` without the rows of ``found``."""
    for _ in range(2):
        vector = vector - (found @ vector) @ found
        vector = vector / np.linalg.norm(vector)
    return vector
