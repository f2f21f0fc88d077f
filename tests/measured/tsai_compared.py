"""The same samples by all-frequency CPCA and by wavelets, at the bytes of CTA and at more."""

import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measured.tsai_pages import CPCA, CPCA_EVEN, CPCA_LARGER, LEAST_BYTES_GAIN, WAVELETS
from measured.tsai_runs import COLUMN_NUMBERS, NUMBER_BYTES, Sampled, cpca_bytes
from prtbake_workers.compress.baselines.segmented_cpca import (
    block_segments,
    compress_all_frequency_cpca,
    even_components,
    spend_numbers,
)
from prtbake_workers.compress.baselines.segmented_cpca_model import SegmentedCpcaModel
from prtbake_workers.compress.baselines.wavelet_transfer import compress_wavelets

F32 = NDArray[np.float32]

N_CLUSTERS = 16
"""In a quarter of the teapot's vertices, at equal bytes, 12 do better than 24, at three times 24 do."""
MOST_COMPONENTS = 32
N_DIMS = 384
DARK_DIMS = 48
"""More than one cluster of that many components could use."""
ITERATIONS = 8
DARK = 1e-4
"""A segment of a smaller share of the energy keeps one cluster."""
PLACE_BYTES = 2


def compare(
    sampled: Sampled, view_bases: Sequence[F32], nbytes: int, samples: F32
) -> Iterator[dict[str, Any]]:
    """Give what differs from CTA's row, for CPCA of as many bytes and of more, and wavelets.

    Each of them takes the view basis that leaves it less.
    """
    tried = [_of_one_basis(sampled, basis, nbytes, samples) for basis in view_bases]
    for rows in zip(*tried, strict=True):
        yield min(rows, key=lambda row: float(row["error"]))


def _of_one_basis(
    sampled: Sampled, view_basis: F32, nbytes: int, samples: F32
) -> list[dict[str, Any]]:
    segments = block_segments(sampled.cube.resolution, sampled.settings.block)
    energy = np.array([np.sum(samples[:, :, texels].astype(float) ** 2) for texels in segments])
    lit = energy > DARK * energy.sum()
    start = time.process_time()
    whole = compress_all_frequency_cpca(
        sampled.segments(segments), segments, np.where(lit, N_CLUSTERS, 1).tolist(), MOST_COMPONENTS,
        seed=sampled.settings.seed, view_basis=view_basis,
        n_dims=np.where(lit, N_DIMS, DARK_DIMS).tolist(),
        max_iterations=ITERATIONS, vertex_weights=sampled.areas,
    )  # fmt: skip
    seconds = time.process_time() - start
    means = cpca_bytes(even_components(whole, 0.0))
    found = []
    for method, keep, target in (
        (CPCA_EVEN, even_components, nbytes),
        (CPCA, spend_numbers, nbytes),
        (CPCA_LARGER, spend_numbers, int(LEAST_BYTES_GAIN * nbytes)),
    ):
        model = keep(
            whole, (target - means) / NUMBER_BYTES,
            column_numbers=COLUMN_NUMBERS, vertex_weights=sampled.areas,
        )  # fmt: skip
        found.append(
            {
                "method": method,
                "detail": _detail(model, view_basis.shape[1]),
                "clusters": N_CLUSTERS,
                "nbytes": cpca_bytes(model),
                "basis_error": 0.0,
                "error": model.squared_error_ratio,
                "direct_error": 0.0,
                "bake_seconds": 0.0,
                "seconds": seconds,
            }
        )
    return [*found, wavelets(sampled, view_basis, nbytes, samples)]


def _detail(model: SegmentedCpcaModel, view_rank: int) -> str:
    kept = np.concatenate([one.ranks for one in model.models])
    return (
        f"{len(model.models)} segments of up to {N_CLUSTERS} clusters, {view_rank} view columns, "
        f"{kept.min()} to {kept.max()} components"
    )


def wavelets(sampled: Sampled, view_basis: F32, nbytes: int, samples: F32) -> dict[str, Any]:
    """Keep the largest Haar coefficients of the drawn vertices, at CTA's bytes a vertex.

    Nothing is shared between vertices, so some of them stand for all.
    """
    start = time.process_time()
    n_verts = len(samples)
    rows = view_basis.T @ samples
    left_out = float(np.sum((samples - view_basis @ rows) ** 2, dtype=np.float64))
    budget = nbytes / sampled.n_vertices * n_verts - 2 * n_verts * rows.shape[1]
    n_kept = max(1, int(budget / (NUMBER_BYTES + PLACE_BYTES)))
    model = compress_wavelets(rows, n_kept)
    energy = float(np.sum(samples.astype(np.float64) ** 2))
    return {
        "method": WAVELETS,
        "detail": f"{n_kept / n_verts:.0f} Haar coefficients a vertex, of {n_verts} vertices, "
        f"{view_basis.shape[1]} view columns",
        "clusters": 0,
        "nbytes": nbytes,
        "basis_error": 0.0,
        "error": (model.objective[-1] + left_out) / energy,
        "direct_error": 0.0,
        "bake_seconds": 0.0,
        "seconds": time.process_time() - start,
    }
