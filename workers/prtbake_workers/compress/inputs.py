"""What the compressors accept, checked before any work is done."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64
from prtbake_workers.compress.energy import row_chunks
from prtbake_workers.compress.rows import Rows, flat

# Squares are taken in float32: beyond these magnitudes they overflow, or vanish altogether.
LARGEST_MAGNITUDE = 1e12
SMALLEST_MAGNITUDE = 1e-12


def checked_signal(signal: NDArray[Any], name: str, axes: tuple[str, ...]) -> F32:
    """Return ``signal`` C-contiguous, or refuse it.

    Parameters
    ----------
    signal
        The array to compress, one row a vertex.
    name
        The argument's name, for the message.
    axes
        Names of its axes, as many as it must have.

    Raises
    ------
    SettingsError
        Wrong type, number of axes, or magnitude; an axis of length 0; a value that is not finite,
        named by its vertex.
    """
    if signal.dtype != np.float32:
        raise SettingsError(f"{name} must be float32, not {signal.dtype}", pointer=f"/{name}")
    signal = np.ascontiguousarray(signal) if signal.ndim else signal
    _check_rows(signal, name, axes)
    return signal


def checked_rows(rows: Rows, name: str, axes: tuple[str, ...]) -> Rows:
    """Return rows that may lie outside of memory, or refuse them as `checked_signal` does."""
    if isinstance(rows, np.ndarray):
        return checked_signal(rows, name, axes)
    _check_rows(rows, name, axes)
    return rows


def _check_rows(signal: Rows, name: str, axes: tuple[str, ...]) -> None:
    """Refuse rows of the wrong shape, of values that are not finite, too large or too small."""
    pointer = f"/{name}"
    if len(signal.shape) != len(axes):
        raise SettingsError(
            f"{name} must have the axes ({', '.join(axes)}), not the shape {signal.shape}",
            pointer=pointer,
        )
    if 0 in signal.shape:
        empty = axes[signal.shape.index(0)]
        raise SettingsError(f"{name} has no {empty}: shape {signal.shape}", pointer=pointer)
    largest = 0.0
    rows = flat(signal)
    for chunk in row_chunks(rows):
        part = rows[chunk]
        peaks = np.maximum(part.max(axis=1), -part.min(axis=1))
        bad = np.flatnonzero(~np.isfinite(peaks))
        if len(bad):
            vertex, row = chunk.start + int(bad[0]), part[bad[0]]
            element = int(np.flatnonzero(~np.isfinite(row))[0])
            where = ", ".join(
                f"{axis} {int(i)}"
                for axis, i in zip(
                    axes[1:], np.unravel_index(element, signal.shape[1:]), strict=True
                )
            )
            raise SettingsError(
                f"{name} is {row[element]} at vertex {vertex} ({where})", pointer=pointer
            )
        largest = max(largest, float(peaks.max()))
    if largest > LARGEST_MAGNITUDE or 0.0 < largest < SMALLEST_MAGNITUDE:
        raise SettingsError(
            f"{name} has the largest magnitude {largest:.3g}; scale it to between "
            f"{SMALLEST_MAGNITUDE:g} and {LARGEST_MAGNITUDE:g}",
            pointer=pointer,
        )


def checked_vertex_weights(vertex_weights: NDArray[Any] | None, n_verts: int) -> F64:
    """Return the weights of the vertices in float64, ones where None is given.

    Raises
    ------
    SettingsError
        Wrong length, a negative or non-finite weight (named by its vertex), or none above zero.
    """
    if vertex_weights is None:
        return np.ones(n_verts)
    pointer = "/vertex_weights"
    weights = np.asarray(vertex_weights, dtype=np.float64)
    if weights.shape != (n_verts,):
        raise SettingsError(
            f"vertex_weights must have the shape ({n_verts},), not {weights.shape}",
            pointer=pointer,
        )
    bad = np.flatnonzero(~(np.isfinite(weights) & (weights >= 0.0)))
    if len(bad):
        raise SettingsError(
            f"vertex_weights is {weights[bad[0]]} at vertex {bad[0]}; weights are >= 0",
            pointer=pointer,
        )
    if not weights.any():
        raise SettingsError("vertex_weights are all zero", pointer=pointer)
    return weights


def checked_count(value: int, name: str) -> int:
    """Return a count that must be at least 1."""
    if value < 1:
        raise SettingsError(f"{name} must be at least 1, not {value}", pointer=f"/{name}")
    return int(value)


def clipped(value: int, limit: int, name: str, reason: str, notes: list[str]) -> int:
    """Return ``value`` or, where that is less, ``limit``, with a note that says so."""
    if value > limit:
        notes.append(f"{name} {value} cut to {limit}: {reason}")
    return min(value, limit)


def fitting_clusters(n_clusters: int, n_verts: int, notes: list[str]) -> int:
    """Return a count of clusters that so many vertices can fill."""
    count = checked_count(n_clusters, "n_clusters")
    return clipped(count, n_verts, "n_clusters", "one vertex a cluster at least", notes)


def fitting_components(n_components: int, signal: F32, notes: list[str]) -> int:
    """Return a count of components that a (verts, dims) signal can fill."""
    n_verts, n_dims = signal.shape
    count = checked_count(n_components, "n_components")
    reason = f"{n_verts} vertices of {n_dims} dimensions span no more"
    return clipped(count, min(n_dims, n_verts), "n_components", reason, notes)
