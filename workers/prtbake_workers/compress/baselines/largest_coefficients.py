"""Non-linear wavelet approximation of transfer: the largest coefficients and where they stand.

[Ng2003]_ keeps the largest coefficients of transport in a Haar basis of the cube map.  Nothing is
shared between vertices: what a coefficient costs, a number and its place, does not fall with their
count, as it does for clusters.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, UInt16
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.energy import row_energy
from prtbake_workers.compress.inputs import checked_count, checked_signal, checked_vertex_weights

U16 = NDArray[np.uint16]
MOST_COEFFS = 1 << 16
"""Places and counts are held in sixteen bits: 6 x 64 x 64 texels fit, 6 x 128 x 128 do not."""


@dataclass(frozen=True, kw_only=True)
class LargestCoefficientsModel:
    """Transfer as the coefficients that were kept; the others are zero.

    Attributes
    ----------
    values
        Kept coefficients, row after row, vertex after vertex.
    places
        Which coefficient of its row each of them is, rising within a row.
    counts
        How many each row keeps.
    n_coeffs
        Coefficients of a row.
    objective
        Squared error, weighted by the vertices' weights; one entry.
    initial_energy
        Squared norm of the tensor with the same weights.
    squared_error_per_vertex
        Squared error of each vertex, without its weight.
    """

    values: Float32[F32, " kept"]
    places: UInt16[U16, " kept"]
    counts: UInt16[U16, "verts rows"]
    n_coeffs: int
    objective: list[float]
    initial_energy: float
    squared_error_per_vertex: Float64[F64, " verts"]

    @property
    def nbytes(self) -> int:
        """Bytes of the float32 values, their places and the counts."""
        return self.values.nbytes + self.places.nbytes + self.counts.nbytes

    @property
    def squared_error_ratio(self) -> float:
        """Squared error over squared norm, both weighted; 0 for a tensor of zeros."""
        return self.objective[-1] / self.initial_energy if self.initial_energy > 0.0 else 0.0

    def reconstruct(self, verts: slice | None = None) -> Float32[F32, "part_verts rows coeffs"]:
        """Return the coefficients of ``verts``, or of every vertex, with zeros between them."""
        n_verts, n_rows = self.counts.shape
        part = np.arange(n_verts)[slice(None) if verts is None else verts]
        ends = np.cumsum(self.counts.reshape(-1), dtype=np.int64).reshape(n_verts, n_rows)
        dense = np.zeros((len(part), n_rows, self.n_coeffs), dtype=np.float32)
        for row, vertex in zip(dense, part, strict=True):
            for k, (end, count) in enumerate(zip(ends[vertex], self.counts[vertex], strict=True)):
                own = slice(int(end) - int(count), int(end))
                row[k, self.places[own]] = self.values[own]
        return dense


def keep_largest(
    coefficients: Float[NDArray[Any], "verts rows coeffs"],
    n_kept: int,
    *,
    vertex_weights: NDArray[Any] | None = None,
) -> LargestCoefficientsModel:
    """Keep the ``n_kept`` coefficients of all vertices that the error needs most.

    Parameters
    ----------
    coefficients
        float32 transfer in an orthonormal basis, wavelets for one, so that squared errors are
        squared radiance errors.
    n_kept
        How many in all, at least 1; zeros are never kept.
    vertex_weights
        Weight of each vertex in the squared error, e.g. its area; ones when None.

    Returns
    -------
    LargestCoefficientsModel
        No other choice of as many has a smaller weighted squared error: in an orthonormal basis the
        error is the sum of a_x c^2 over what was left out.  A row may keep many and its neighbour
        none.

    Raises
    ------
    SettingsError
        For what cannot be used; for rows of more than `MOST_COEFFS`.
    """
    c = checked_signal(coefficients, "coefficients", ("verts", "rows", "coeffs"))
    n_verts, n_rows, n_coeffs = c.shape
    weights = checked_vertex_weights(vertex_weights, n_verts)
    n_kept = min(checked_count(n_kept, "n_kept"), c.size)
    if n_coeffs >= MOST_COEFFS:
        raise SettingsError(
            f"rows of {n_coeffs} coefficients: places are held in 16 bits", pointer="/coefficients"
        )
    energy = row_energy(c.reshape(n_verts, -1))
    score = (weights[:, None, None] * c.astype(np.float64) ** 2).reshape(-1)
    chosen = np.sort(np.argpartition(score, c.size - n_kept)[c.size - n_kept :])
    chosen = chosen[c.reshape(-1)[chosen] != 0.0]
    rows, places = np.divmod(chosen, n_coeffs)
    counts = np.bincount(rows, minlength=n_verts * n_rows).reshape(n_verts, n_rows)
    rest = c.reshape(-1).copy()
    values = rest[chosen]
    rest[chosen] = 0.0
    errors = row_energy(rest.reshape(n_verts, -1))
    return LargestCoefficientsModel(
        values=values,
        places=places.astype(np.uint16),
        counts=counts.astype(np.uint16),
        n_coeffs=n_coeffs,
        objective=[float(weights @ errors)],
        initial_energy=float(weights @ energy),
        squared_error_per_vertex=errors,
    )
