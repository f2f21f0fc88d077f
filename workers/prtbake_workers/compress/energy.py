"""Squared norms of rows, chunk by chunk, with sums in float64."""

from collections.abc import Iterator

import numpy as np

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.rows import Rows

# Rows are walked in pieces of about this size: small beside the data, large beside the cache.
CHUNK_BYTES = 32 << 20
# Neighbouring squares are added in float32 in runs of at most this length, the runs in float64:
# a run's rounding is below 1e-6 of itself and independent of its neighbours'.
RUN_LENGTH = 128


def row_chunks(rows: Rows, chunk_bytes: int = CHUNK_BYTES) -> Iterator[slice]:
    """Yield slices that cover the first axis of ``rows``, each of about ``chunk_bytes``."""
    n_rows = len(rows)
    bytes_per_row = max(1, rows.nbytes // max(1, n_rows))
    step = max(1, chunk_bytes // bytes_per_row)
    for start in range(0, n_rows, step):
        yield slice(start, min(n_rows, start + step))


def row_energy(rows: Float32[F32, "verts dims"]) -> Float64[F64, " verts"]:
    """Return the squared norm of each row."""
    n_rows, n_dims = rows.shape
    whole = n_dims - n_dims % RUN_LENGTH
    runs = rows[:, :whole].reshape(n_rows, whole // RUN_LENGTH, RUN_LENGTH)
    energy = np.einsum("vbj,vbj->vb", runs, runs).sum(axis=1, dtype=np.float64)
    rest = rows[:, whole:]
    return np.asarray(energy + np.einsum("vj,vj->v", rest, rest), dtype=np.float64)


def row_energy_by_chunks(signal: Rows) -> Float64[F64, " verts"]:
    """Return the squared norm of each (dims,) row, without a copy of the whole signal."""
    return np.concatenate([row_energy(signal[chunk]) for chunk in row_chunks(signal)])
