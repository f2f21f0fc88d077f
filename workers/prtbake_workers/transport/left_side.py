"""The left side of the projection: transport sampled over a group of vertices."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.transport.visibility import visible_fraction

CACHED_SAMPLES = 16_384
"""Samples of each term at a time: 1 MB at 16 terms."""


@dataclass(frozen=True)
class Sampling:
    """What all chunks of a block share.

    Attributes
    ----------
    samples
        Directions of the rays, one set a supersample, padded (see `padded_directions`).
    centres
        Centres of the texels, a row a component.
    root_weights
        Square roots of the solid angles.
    n_pairs
        Pairs of directions whose samples are folded, see `fold_pairs`.
    """

    samples: Float32[F32, "samples dirs 4"]
    centres: Float32[F32, "3 dirs"]
    root_weights: Float32[F32, " dirs"]
    n_pairs: tuple[int, int] = (0, 0)

    @classmethod
    def of(cls, directions: F64, samples: F32, weights: F64) -> "Sampling":
        """Convert to float32 once; ``samples`` as from `padded_directions`."""
        return cls(
            samples=samples,
            centres=np.ascontiguousarray(directions.T, dtype=np.float32),
            root_weights=np.sqrt(weights).astype(np.float32),
        )

    def pick(self, directions: np.ndarray, n_pairs: tuple[int, int] = (0, 0)) -> "Sampling":
        """Keep some of the directions, which may be in pairs."""
        return Sampling(
            samples=self.samples.take(directions, axis=1),
            centres=self.centres.take(directions, axis=1),
            root_weights=self.root_weights.take(directions),
            n_pairs=n_pairs,
        )


class Workspace:
    """Buffers of one thread, reused from chunk to chunk: fresh pages cost more than the sums."""

    def __init__(self) -> None:
        self._buffers: dict[str, F32] = {}

    def array(self, name: str, shape: tuple[int, ...]) -> F32:
        """Return an array of that shape whose content is arbitrary."""
        size = int(np.prod(shape))
        buffer = self._buffers.get(name)
        if buffer is None or buffer.size < size:
            buffer = self._buffers[name] = np.empty(size, np.float32)
        return buffer[:size].reshape(shape)


def fold_pairs(
    samples: Float32[F32, "terms verts dirs"], n_pairs: tuple[int, int], work: Workspace
) -> None:
    """Replace the samples of pairs by sum and difference, in place.

    Parameters
    ----------
    samples
        Runs of n firsts and n seconds, one after the other.
    n_pairs
        n of each two runs; what lies behind stays.
    work
        Buffers.
    """
    start = 0
    for n in n_pairs:
        first, second = samples[..., start : start + n], samples[..., start + n : start + 2 * n]
        total = np.add(first, second, out=work.array("sums", first.shape))
        np.subtract(first, second, out=second)
        first[...] = total
        start += 2 * n


def unfold_pairs(samples: Float32[F32, "terms dirs"], n_pairs: tuple[int, int]) -> None:
    """Undo `fold_pairs`."""
    fold_pairs(samples[:, None], n_pairs, Workspace())
    samples[:, : 2 * sum(n_pairs)] *= np.float32(0.5)


def local_directions(
    frames: Float64[F64, "verts 3 3"], sampling: Sampling, work: Workspace
) -> Float32[F32, "3 verts dirs"]:
    """Turn the directions into every vertex's frame; the last component is the cosine."""
    n_verts, n_dirs = len(frames), len(sampling.root_weights)
    local = work.array("local", (3 * n_verts, n_dirs))
    rows = np.ascontiguousarray(frames.transpose(1, 0, 2), dtype=np.float32).reshape(-1, 3)
    np.matmul(rows, sampling.centres, out=local)
    return local.reshape(3, n_verts, n_dirs)


def visible_share(
    accelerator: Accelerator | None,
    origins: Float32[F32, "verts 3"],
    normals: Float32[F32, "verts 3"],
    cosines: Float32[F32, "verts dirs"],
    sampling: Sampling,
    work: Workspace,
) -> tuple[Float32[F32, "verts dirs"], int]:
    """Return the visible share of every direction and the rays traced; None shadows nothing."""
    share = work.array("share", cosines.shape)
    if accelerator is None:
        share.fill(1.0)
        return share, 0
    n_rays = visible_fraction(accelerator, origins, normals, cosines, sampling.samples, share)
    return share, n_rays


def weighted_transport(
    factorisation: Factorisation,
    local: Float32[F32, "3 verts dirs"],
    share: Float32[F32, "verts dirs"],
    sampling: Sampling,
    work: Workspace,
) -> tuple[Float32[F32, "terms verts dirs"], Float64[F64, " verts"]]:
    """Sample ``sqrt(W) T_k(w) = sqrt(W) psi_k(w_local) V(w) max(0, n . w)``, [Tsai2006]_ eq. (9).

    A few vertices at a time, so that what the lookup writes is still in the cache when it is
    multiplied and squared.

    Parameters
    ----------
    factorisation
        psi.
    local
        Directions in the vertices' frames; the last component is n . w.
    share
        V; overwritten with the part that the terms have in common.
    sampling
        For the solid angles W.
    work
        Buffers; the samples live in one of them until the next call.

    Returns
    -------
    terms, energy
        The samples, sums and differences where directions are in pairs, and the sum of the samples'
        squares for each vertex: rows in float32 blocks, the sum over terms in float64.
    """
    n_verts, n_dirs = share.shape
    terms = work.array("terms", (factorisation.n_terms, n_verts, n_dirs))
    squares = np.empty((factorisation.n_terms, n_verts), np.float32)
    step = max(1, CACHED_SAMPLES // n_dirs)
    for start in range(0, n_verts, step):
        part = slice(start, start + step)
        common, rows = share[part], terms[:, part]
        common *= np.maximum(local[2, part], np.float32(0.0))
        common *= sampling.root_weights
        x, y, z = local[:, part].reshape(3, -1)
        factorisation.psi_lookup(x, y, z, rows.reshape(len(rows), -1))
        rows *= common
        np.vecdot(rows, rows, out=squares[:, part])
        fold_pairs(rows, sampling.n_pairs, work)
    return terms, squares.sum(axis=0, dtype=np.float64)
