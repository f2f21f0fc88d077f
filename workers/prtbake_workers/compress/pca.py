"""Principal component analysis of transfer: clustered PCA ([Sloan2003]_) with one cluster.

All vertices are one matrix here, which a glossy part makes larger than memory should hold twice.
So the Gram matrix of its shorter side is summed piece by piece, and no copy of the signal is made.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.clusters import squared_distances, weighted_mean
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.energy import row_chunks, row_energy, row_energy_by_chunks
from prtbake_workers.compress.gram_eigh import (
    RANK_TOLERANCE,
    leading_eigenvectors,
    orthonormal_rows,
)
from prtbake_workers.compress.inputs import (
    checked_signal,
    checked_vertex_weights,
    fitting_components,
)
from prtbake_workers.compress.monotone import ObjectiveTrace
from prtbake_workers.compress.parallel import map_in_order, same_bytes_on_any_threads
from prtbake_workers.compress.progress import Progress, no_progress

# Of the signal, in float64, while it is summed.
PIECE_BYTES = 32 << 20
# Of the Gram matrix, a task each: more would convert the same pieces more often.
BANDS = 4


def compress_pca(
    signal: Float[NDArray[Any], "verts dims"],
    n_components: int,
    *,
    seed: int,
    vertex_weights: NDArray[Any] | None = None,
    progress: Progress = no_progress,
) -> CpcaModel:
    """Approximate each row of ``signal`` by the mean of all and its principal components.

    Parameters
    ----------
    signal
        float32 coefficients of each vertex in an orthonormal (whitened) basis, so that squared
        errors are squared radiance errors.
    n_components
        At least 1; cut to what the signal can fill.
    seed
        Kept in the model; there is nothing to draw.
    vertex_weights
        Weight of each vertex in mean and squared error, >= 0, e.g. its area; ones when None.
    progress
        Called with the fraction done and a word on the state.

    Returns
    -------
    CpcaModel
        With one cluster.  The error is the least that so many components can have, the bytes are
        the same on any number of threads.

    Raises
    ------
    SettingsError
        For what cannot be used, with the argument as pointer and the vertex in the message.
    """
    return Principal(signal, vertex_weights).model(n_components, seed=seed, progress=progress)


class Principal:
    """A signal's mean and Gram matrix, from which models of any number of components follow.

    Who tries several numbers sums and decomposes the matrix once; it lives as long as this does.

    Parameters
    ----------
    signal, vertex_weights
        As of `compress_pca`.

    Raises
    ------
    SettingsError
        As `compress_pca`.
    """

    def __init__(
        self,
        signal: Float[NDArray[Any], "verts dims"],
        vertex_weights: NDArray[Any] | None = None,
    ) -> None:
        self.signal: F32 = checked_signal(signal, "signal", ("verts", "dims"))
        self.weights = checked_vertex_weights(vertex_weights, len(self.signal))
        self._gram: F64 | None = None
        self._eigen: tuple[F64, F64] | None = None
        with same_bytes_on_any_threads():
            self.mean = weighted_mean(self.signal, self.weights)
            self.squared_norm = float(self.weights @ row_energy_by_chunks(self.signal))
            self.about_mean = float(self.weights @ squared_distances(self.signal, self.mean))

    def model(self, n_components: int, *, seed: int, progress: Progress = no_progress) -> CpcaModel:
        """Return the model of so many components; see `compress_pca`."""
        x, mean = self.signal, self.mean
        n_verts, n_dims = x.shape
        notes: list[str] = []
        n_components = fitting_components(n_components, x, notes)
        trace = ObjectiveTrace(self.squared_norm, "PCA")
        trace.append(self.about_mean)
        with same_bytes_on_any_threads():
            progress(0.0, "mean and covariance")
            basis = self._rows(n_components)
            progress(0.9, "weights")
            coefficients = np.zeros((n_verts, n_components), np.float32)
            errors = np.empty(n_verts)

            def project(chunk: slice) -> None:
                centred = x[chunk] - mean
                projected = centred @ basis.T
                coefficients[chunk, : len(basis)] = projected
                errors[chunk] = row_energy(centred - np.matmul(projected, basis, dtype=np.float32))

            map_in_order(project, row_chunks(x))
            trace.append(float(self.weights @ errors))
        components = np.zeros((1, n_components, n_dims), np.float32)
        components[0, : len(basis)] = basis
        progress(1.0, f"error {trace.ratio:.3%}")
        return CpcaModel(
            means=mean[None],
            components=components,
            weights=coefficients,
            labels=np.zeros(n_verts, np.int32),
            ranks=np.array([len(basis)], np.int32),
            objective=trace.values,
            initial_energy=trace.squared_norm,
            squared_error_per_vertex=errors,
            iterations=1,
            seed=seed,
            notes=notes,
        )

    def _rows(self, rank: int) -> Float32[F32, "kept dims"]:
        """Return the leading right singular vectors of the weighted x - mean, at its true rank."""
        n_verts, n_dims = self.signal.shape
        tall = n_verts >= n_dims
        length, size = (n_verts, n_dims) if tall else (n_dims, n_verts)
        columns = self._of_verts if tall else self._of_dims
        step = max(1, PIECE_BYTES // (8 * size))
        pieces = [slice(start, min(start + step, length)) for start in range(0, length, step)]
        if self._gram is None:
            self._gram = _gram(columns, pieces, size)
        if self._eigen is None or len(self._eigen[0]) < min(rank, size):
            # who asks again may ask for more yet
            more = rank if self._eigen is None else 2 * rank
            self._eigen = leading_eigenvectors(self._gram, more)
        values, vectors = self._eigen[0][:rank], self._eigen[1][:, :rank]
        kept = int(np.count_nonzero(values > RANK_TOLERANCE * values.max(initial=0.0)))
        values, basis = values[:kept], np.ascontiguousarray(vectors[:, :kept].T)
        if not tall:
            scaled = basis / np.sqrt(values)[:, None]
            parts = [scaled @ columns(piece) for piece in pieces]
            basis = orthonormal_rows(np.concatenate(parts, axis=1))
        return basis.astype(np.float32)

    def _of_verts(self, piece: slice) -> F64:
        centred = (self.signal[piece] - self.mean).astype(np.float64)
        return (centred * np.sqrt(self.weights[piece])[:, None]).T

    def _of_dims(self, piece: slice) -> F64:
        centred = (self.signal[:, piece] - self.mean[piece]).astype(np.float64)
        return centred * np.sqrt(self.weights)[:, None]


def _gram(
    columns: Callable[[slice], F64], pieces: Sequence[slice], size: int
) -> Float64[F64, "size size"]:
    """Sum C C^T over the pieces C of a matrix, a band of its rows a task."""
    gram = np.zeros((size, size))
    # a band goes as far as the diagonal, which leaves each about the same
    edges = (size * np.sqrt(np.linspace(0.0, 1.0, BANDS + 1))).astype(int).tolist()

    def fill(band: slice) -> None:
        for piece in pieces:
            own = columns(piece)
            gram[band, : band.stop] += own[band] @ own[: band.stop].T
        gram[: band.start, band] = gram[band, : band.start].T

    map_in_order(fill, [slice(a, b) for a, b in pairwise(edges)])
    return gram
