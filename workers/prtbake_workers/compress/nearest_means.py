"""Every vertex to its nearest mean, with distances taken only where a nearer mean is possible.

A mean that moved by t is nearer to a vertex than it was by at most t ([Elkan2003]_, after the
triangle inequality).  So distances once taken bound later ones from below, and a vertex whose own
mean is nearer than all bounds stays without a product: after ten iterations nine in ten do.

Bounds are lowered by what rounding can add, so clusters are those that all distances would give, up
to ties in float32: a product of fewer rows may round otherwise.
"""

from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int32
from prtbake_workers.compress.energy import row_chunks, row_energy
from prtbake_workers.compress.parallel import map_in_order
from prtbake_workers.compress.rows import Rows

CHUNK_BYTES = 8 << 20
"""Of signal at a time: its distances stay in the cache until they have become bounds."""

MOST_BOUND_BYTES = 64 << 20
"""Of bounds; with more vertices times clusters every distance is taken every time."""

FLOAT32_ROUNDING = 2.0**-24
BOUND_ROUNDING = 1e-6
"""Of bounds and of their distances moved: more than the five roundings to float32 between them."""


class CentredMeans(NamedTuple):
    """Means m about an origin o, so that a product gives squared distances up to the vertex' own.

    |x - m|^2 = |x - o|^2 - 2 x.(m - o) + (|m - o|^2 + 2 o.(m - o)): the last term is ``constant``.
    """

    centred: Float32[F32, "clusters dims"]
    constant: Float64[F64, " clusters"]
    lengths: Float64[F64, " clusters"]


def centred_means(
    means: Float32[F32, "clusters dims"], origin: Float32[F32, " dims"]
) -> CentredMeans:
    """Return the means about ``origin``, with what they add to squared distances."""
    centred = means - origin
    squares = row_energy(centred)
    constant = squares + 2.0 * (centred.astype(np.float64) @ origin)
    return CentredMeans(centred, constant, np.sqrt(squares))


class NearestMeans:
    """Moves vertices to their nearest means, again and again as the means move."""

    def __init__(
        self,
        signal: Rows,
        means: Float32[F32, "clusters dims"],
        energy: Float64[F64, " verts"],
    ) -> None:
        """Take the signal, the first means, and the squared norm of each row of the signal."""
        self._signal, self._lengths = signal, np.sqrt(energy)
        self._origin: F32 = means.mean(axis=0, dtype=np.float64).astype(np.float32)
        self._origin_length = float(np.linalg.norm(self._origin.astype(np.float64)))
        self._last: F32 | None = None
        self._labels: I32 = np.full(len(signal), -1, np.int32)
        self._gone: F64 = np.zeros(len(means))
        n_bytes = 4 * len(signal) * len(means)
        # lower bound of a distance, plus all that its mean had gone when it was taken
        self._bounds: F32 | None = None
        # upper bound of the distance to the own mean
        self._reach: F64 = np.full(len(signal), np.inf)
        self._about: F64 | None = None
        if n_bytes <= MOST_BOUND_BYTES:
            self._bounds = np.full((len(signal), len(means)), -np.inf, np.float32)
            self._about = row_energy_about(signal, self._origin)

    def move(
        self,
        labels: Int32[I32, " verts"],
        means: Float32[F32, "clusters dims"],
    ) -> int:
        """Move each vertex to its nearest mean; return how many moved, the first time all.

        Parameters
        ----------
        labels
            Cluster of each vertex, which changes in place; the first time, of nobody.  Others may
            have changed it since the last call.
        means
            Of the clusters; any of them may have moved since the last call.

        Notes
        -----
        A product ranks the means.  A vertex moves only when its squared distance, taken as the
        difference itself, falls: rounding in the product moves nobody.
        """
        first = self._last is None
        self._follow(labels, means)
        about = centred_means(means, self._origin)
        # (dims, clusters) in the product; doubling is exact
        doubled, constant = -2.0 * about.centred, about.constant.astype(np.float32)

        def move(chunk: slice) -> int:
            own = labels[chunk]
            rows, active = self._signal[chunk], self._active(chunk, own)
            if len(active) < len(own):
                rows = rows[active]
            ranked = rows @ doubled.T
            ranked += constant
            proposed = np.argmin(ranked, axis=1).astype(np.int32)
            there = own[active]
            movers = np.arange(len(there)) if first else np.flatnonzero(proposed != there)
            if not first:
                candidates = rows[movers]
                nearer = row_energy(candidates - means[proposed[movers]]) < row_energy(
                    candidates - means[there[movers]]
                )
                movers = movers[nearer]
            own[active[movers]] = proposed[movers]
            self._renew(chunk, active, ranked, own[active], about)
            return len(movers)

        n_moved = sum(map_in_order(move, row_chunks(self._signal, CHUNK_BYTES)))
        self._labels = labels.copy()
        return n_moved

    def _follow(self, labels: I32, means: F32) -> None:
        """Widen the bounds by what means, and vertices that others moved, have gone."""
        if self._last is not None:
            step = np.sqrt(row_energy(means - self._last))
            self._gone = self._gone + step
            known = labels == self._labels
            self._reach = np.where(known, self._reach + step[labels], np.inf)
        self._last = means.copy()

    def _active(self, chunk: slice, labels: I32) -> I64:
        """Return the vertices of a chunk that may have a nearer mean."""
        if self._bounds is None:
            return np.arange(len(labels), dtype=np.int64)
        least = self._bounds[chunk] - self._gone.astype(np.float32)
        least[np.arange(len(labels)), labels] = np.inf
        slack = BOUND_ROUNDING * self._gone.max()
        reach = self._reach[chunk] * (1.0 + BOUND_ROUNDING) + slack
        return np.flatnonzero(least.min(axis=1) <= reach)

    def _renew(
        self, chunk: slice, active: I64, ranked: F32, labels: I32, about: CentredMeans
    ) -> None:
        """Make bounds of what the product gave; ``ranked`` is overwritten."""
        if self._bounds is None or self._about is None:
            return
        squares, lengths = self._about[chunk][active], self._lengths[chunk][active]
        # any order of summation errs by at most this share of the product of the lengths
        share = (self._signal.shape[1] + 8) * FLOAT32_ROUNDING
        # the two halves of ``constant``, |m - o|^2 and 2 o.(m - o), may cancel; their errors do not
        longest = about.lengths.max()
        halves = longest * (longest + 2.0 * self._origin_length)
        error = share * (squares + halves + 2.0 * lengths * longest)
        ranked += (squares - error).astype(np.float32)[:, None]
        own = ranked[np.arange(len(active)), labels] + 2.0 * error
        self._reach[chunk][active] = np.sqrt(np.maximum(own, 0.0))
        np.maximum(ranked, 0.0, out=ranked)
        np.sqrt(ranked, out=ranked)
        ranked += self._gone.astype(np.float32)
        self._bounds[chunk][active] = ranked


def row_energy_about(signal: Rows, origin: Float32[F32, " dims"]) -> Float64[F64, " verts"]:
    """Return the squared distance of each row to one point."""
    chunks = row_chunks(signal, CHUNK_BYTES)
    return np.concatenate(map_in_order(lambda chunk: row_energy(signal[chunk] - origin), chunks))
