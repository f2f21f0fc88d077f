"""The same samples by all-frequency CPCA and by wavelets, at the bytes of CTA and at more."""

import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from measured.tsai_pages import CPCA, CPCA_LARGER, LEAST_BYTES_GAIN, WAVELETS
from measured.tsai_runs import NUMBER_BYTES, Sampled, cpca_bytes
from prtbake_workers.compress.baselines.segmented_cpca import (
    block_segments,
    compress_all_frequency_cpca,
    spend_components,
)
from prtbake_workers.compress.baselines.segmented_cpca_model import SegmentedCpcaModel
from prtbake_workers.compress.baselines.wavelet_transfer import compress_wavelets

F32 = NDArray[np.float32]
I64 = NDArray[np.int64]

N_CLUSTERS = 24
MOST_COMPONENTS = 32
N_DIMS = 384
ITERATIONS = 8
DARK = 1e-4
"""A segment of a smaller share of the energy keeps one cluster."""
PLACE_BYTES = 2


def compare(
    sampled: Sampled, view_basis: F32, nbytes: int, drawn: I64, samples: F32
) -> Iterator[dict[str, Any]]:
    """Give what differs from CTA's row, for CPCA of as many bytes and of more, and wavelets."""
    segments = block_segments(sampled.cube.resolution, sampled.settings.block)
    energy = np.array([np.sum(samples[:, :, texels].astype(float) ** 2) for texels in segments])
    counts = np.where(energy > DARK * energy.sum(), N_CLUSTERS, 1).tolist()
    start = time.process_time()
    whole = compress_all_frequency_cpca(
        sampled.segments(segments), segments, counts, MOST_COMPONENTS,
        seed=sampled.settings.seed, view_basis=view_basis, n_dims=N_DIMS,
        max_iterations=ITERATIONS, vertex_weights=sampled.areas,
    )  # fmt: skip
    seconds = time.process_time() - start
    for method, target in ((CPCA, nbytes), (CPCA_LARGER, LEAST_BYTES_GAIN * nbytes)):
        model = spent_to(whole, sampled, int(target))
        yield {
            "method": method,
            "detail": _detail(model),
            "clusters": N_CLUSTERS,
            "nbytes": cpca_bytes(model),
            "basis_error": 0.0,
            "error": model.squared_error_ratio,
            "direct_error": 0.0,
            "bake_seconds": 0.0,
            "seconds": seconds,
        }
    yield wavelets(sampled, view_basis, nbytes, samples)


def spent_to(whole: SegmentedCpcaModel, sampled: Sampled, nbytes: int) -> SegmentedCpcaModel:
    """Return the smallest choice of components that takes at least ``nbytes``."""
    most = sum(one.weights.shape[1] for one in whole.models)
    few, many = 0, most
    while few < many:
        middle = (few + many) // 2
        tried = spend_components(whole, middle, vertex_weights=sampled.areas)
        if cpca_bytes(tried) < nbytes:
            few = middle + 1
        else:
            many = middle
    return spend_components(whole, few, vertex_weights=sampled.areas)


def _detail(model: SegmentedCpcaModel) -> str:
    kept = [one.weights.shape[1] for one in model.models]
    return f"{len(kept)} segments of up to {N_CLUSTERS} clusters, {min(kept)} to {max(kept)} components"


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
        "detail": f"{n_kept / n_verts:.0f} Haar coefficients a vertex, of {n_verts} vertices",
        "clusters": 0,
        "nbytes": nbytes,
        "basis_error": 0.0,
        "error": (model.objective[-1] + left_out) / energy,
        "direct_error": 0.0,
        "bake_seconds": 0.0,
        "seconds": time.process_time() - start,
    }
