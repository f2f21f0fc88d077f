"""Symmetries of a projection: what swaps directions, and functions, and changes nothing."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.basis.projection import LeastSquaresProjection

ASYMMETRY = 1e-9
"""Largest deviation from symmetry, relative: far below float32, and above what whitening leaves
but where a basis is nearly dependent."""

COMPARED_ROWS = 48
"""Directions compared at a time: at 642 functions they stay in the cache."""


class Image(NamedTuple):
    """What a symmetry does: index of each direction's image; of each function's, and its sign."""

    directions: Int64[I64, " dirs"]
    functions: Int64[I64, " coeffs"]
    signs: Float64[F64, " coeffs"]


def image_of(
    projection: LeastSquaresProjection,
    directions: Float64[F64, "dirs 3"],
    flips: Float64[F64, " 3"],
) -> Image | None:
    """Follow directions and functions through a symmetry that moves every direction.

    Parameters
    ----------
    projection, directions
        Of an orthonormal basis, and where it is sampled.
    flips
        What the symmetry multiplies the components of a direction by: 1 or -1.

    Returns
    -------
    Image or None
        None where directions, weights, matrix or Gram matrix are not the same afterwards.
    """
    distance, at = cKDTree(directions).query(directions * flips)
    weights, matrix = projection.weights, projection.matrix
    if (
        distance.max() > ASYMMETRY
        or len(np.unique(at)) < len(at)
        or (at == np.arange(len(at))).any()
        or np.abs(weights[at] - weights).max() > ASYMMETRY * weights.max()
    ):
        return None
    # functions are told apart by a few sums over the directions
    probes = np.random.default_rng(0).standard_normal((4, len(at)))
    moved = np.empty_like(probes)
    moved[:, at] = probes
    before, after = (probes @ matrix).T, (moved @ matrix).T
    _, found = cKDTree(np.concatenate([before, -before])).query(after)
    functions = found % len(before)
    signs = np.where(found < len(before), 1.0, -1.0)
    if len(np.unique(functions)) < len(functions):
        return None
    image = Image(at, functions, signs)
    gram = projection.gram[np.ix_(functions, functions)] * np.outer(signs, signs)
    same = np.abs(gram - projection.gram).max() <= ASYMMETRY * np.abs(projection.gram).max()
    defect = max(
        float(np.abs(matrix[at[some]] - matrix[some][:, functions] * signs).max())
        for some in np.array_split(np.arange(len(at)), -(-len(at) // COMPARED_ROWS))
    )
    return image if same and defect <= ASYMMETRY * np.abs(matrix).max() else None
