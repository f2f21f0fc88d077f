"""How many view columns a part's compression keeps, from its BRDF's spectrum."""

import numpy as np

from prtbake_workers.arrays import F64, Float64

MOST_VIEW_BYTES = 1 << 30
"""Transfer of a part in its view columns, in float32: what the compression holds twice."""


def view_rank(
    least: int,
    singular_values: Float64[F64, " values"],
    energy_lost: float,
    *,
    vertex_bytes: int,
    n_verts: int,
) -> int:
    """Choose the view rank of a part: at least the ladder's, more where the BRDF needs more.

    The best R view columns keep no less of the transfer than its first R terms, whose share of the
    BRDF's energy the singular values tell.

    Parameters
    ----------
    least
        The ladder's.
    singular_values
        Of the BRDF's factorisation, falling.
    energy_lost
        Share of the energy that the columns may leave.
    vertex_bytes
        Of one vertex and one view column, in float32; `MOST_VIEW_BYTES` are not exceeded for more
        than the least.
    n_verts
        Vertices of the part.
    """
    energy = singular_values**2
    left = energy.sum() - np.cumsum(energy)
    needed = int(np.argmax(left <= energy_lost * energy.sum())) + 1
    affordable = MOST_VIEW_BYTES // max(1, vertex_bytes * n_verts)
    return max(least, min(needed, affordable))
