"""All-frequency CPCA ([Liu2004]_ as [Tsai2006]_ section 7.1 and table 2 describe it).

The light axis holds the texels of a cube map, thousands of them, and is cut into segments of a
fixed size.  In each segment the vertices are clustered anew, and one PCA is fitted to the (view,
light) matrices of each cluster.  Nothing is shared between segments but the view basis, so a vertex
has as many sets of weights as there are segments, and coherence along the light axis is found
inside a segment only.

[Liu2004]_ holds the light in Haar wavelets.  An orthonormal transform inside a segment turns the
bases of a cluster and changes neither its error nor its size, so texels serve as well here.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64
from prtbake_workers.compress.baselines.segmented_cpca_model import SegmentedCpcaModel
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.energy import row_chunks, row_energy, row_energy_by_chunks
from prtbake_workers.compress.gram_eigh import leading_eigenvectors
from prtbake_workers.compress.inputs import checked_count, checked_signal, checked_vertex_weights
from prtbake_workers.compress.progress import Progress, no_progress
from prtbake_workers.compress.view_basis import project_view

N_FACES = 6
SAMPLE_VERTS = 4096
"""The leading dimensions of a segment are those of so many vertices, drawn at random."""


def block_segments(resolution: int, block: int) -> list[Int64[I64, " texels"]]:
    """Cut the texels of a cube map into square blocks: 24 of 256 at 6 x 32 x 32 and 16.

    Parameters
    ----------
    resolution
        N texels along an edge; faces one after the other, row by row.
    block
        Texels along an edge of a block; must divide ``resolution``.

    Returns
    -------
    list of ndarray
        Indices of the texels of each block, face by face.
    """
    checked_count(block, "block")
    if resolution % block:
        raise SettingsError(
            f"block {block} does not divide the resolution {resolution}", pointer="/block"
        )
    n = resolution // block
    texels = np.arange(N_FACES * resolution**2).reshape(N_FACES, n, block, n, block)
    return list(texels.transpose(0, 1, 3, 2, 4).reshape(N_FACES * n * n, block * block))


def cut(
    transfer: Float32[F32, "verts rows texels"], segments: Sequence[Int64[I64, " _"]]
) -> Iterator[Float32[F32, "verts rows _"]]:
    """Give the columns of each segment of a transfer tensor that is held as a whole."""
    for texels in segments:
        yield np.ascontiguousarray(transfer[:, :, texels])


def compress_all_frequency_cpca(
    parts: Iterable[Float[NDArray[Any], "verts rows _"]],
    segments: Sequence[Int64[I64, " _"]],
    n_clusters: int | Sequence[int],
    n_components: int,
    *,
    seed: int,
    view_basis: Float32[F32, "rows r_view"] | None = None,
    n_dims: int | None = None,
    max_iterations: int = 40,
    vertex_weights: NDArray[Any] | None = None,
    progress: Progress = no_progress,
) -> SegmentedCpcaModel:
    """Compress transfer segment by segment of its light axis.

    Parameters
    ----------
    parts
        float32 transfer of all vertices in each segment, times the root of the texels' solid
        angles and with orthonormal view functions, so that squared errors are squared radiance
        errors.  They are taken one at a time: only one has to be held (`cut` makes them from a
        whole tensor).
    segments
        Texels of each of them.
    n_clusters, n_components
        Clusters of each segment, or one number for all, and components in each of those, at least
        1; cut to what a segment can fill.
    seed
        Start of the clusterings.
    view_basis
        U_view with orthonormal columns, which the rows are reduced by first; None keeps them all.
        What it leaves out is part of the error.
    n_dims
        Clusters and components are sought in so many leading dimensions of each segment; None in
        all of them, which takes far longer.  What lies outside is part of the error.
    max_iterations
        Most iterations of each clustering.
    vertex_weights
        Weight of each vertex in the squared error, e.g. its area; ones when None.
    progress
        Called after each segment.

    Raises
    ------
    SettingsError
        For what cannot be used: see `compress_cpca`, and parts that do not fit the segments.
    """
    counts = [n_clusters] * len(segments) if isinstance(n_clusters, int) else list(n_clusters)
    if len(counts) != len(segments) or not segments:
        raise SettingsError(
            f"{len(counts)} numbers of clusters for {len(segments)} segments",
            pointer="/n_clusters",
        )
    models: list[CpcaModel] = []
    weights, errors, energy = np.zeros(0), np.zeros(0), np.zeros(0)
    for part, texels, count in zip(parts, segments, counts, strict=True):
        t = checked_signal(part, "parts", ("verts", "rows", "texels"))
        if not models:
            weights = checked_vertex_weights(vertex_weights, len(t))
            errors, energy = np.zeros(len(t)), np.zeros(len(t))
        if t.shape[2] != len(texels) or len(t) != len(weights):
            raise SettingsError(
                f"part {len(models)} has the shape {t.shape}, for {len(weights)} vertices and a "
                f"segment of {len(texels)} texels",
                pointer="/parts",
            )
        energy += row_energy_by_chunks(t.reshape(len(t), -1))
        z = t
        if view_basis is not None:
            z = np.empty((len(t), view_basis.shape[1], t.shape[2]), dtype=np.float32)
            errors += project_view(t, view_basis, z)
        signal = z.reshape(len(z), -1)
        dims = None
        if n_dims is not None and n_dims < signal.shape[1]:
            dims = _leading_dims(signal, weights, checked_count(n_dims, "n_dims"), seed)
            signal, outside = _in_dims(signal, dims)
            errors += outside
        model = compress_cpca(
            signal, count, n_components, method="static", seed=seed,
            max_iterations=max_iterations, vertex_weights=weights,
        )  # fmt: skip
        errors += model.squared_error_per_vertex
        models.append(model if dims is None else _out_of_dims(model, dims))
        progress(len(models) / len(segments), f"segment {len(models)} of {len(segments)}")
    return SegmentedCpcaModel(
        segments=[np.asarray(texels, dtype=np.int64) for texels in segments],
        models=models,
        view_basis=view_basis,
        objective=[float(weights @ errors)],
        initial_energy=float(weights @ energy),
        squared_error_per_vertex=errors,
        seed=seed,
    )


def spend_components(
    model: SegmentedCpcaModel,
    total: int,
    *,
    vertex_weights: Float64[F64, " verts"] | None = None,
) -> SegmentedCpcaModel:
    """Keep ``total`` components a cluster, all segments together, where they capture most.

    [Liu2004]_ gives every segment as many; half of the light of an object on a plane carries next
    to nothing.

    Parameters
    ----------
    model
        With as many components in each segment as the richest may need.
    total
        At least 0; a segment may be left with its means.
    vertex_weights
        Those that it was compressed with.

    Notes
    -----
    Components of a cluster are orthonormal, strongest first.  What the p-th ones of a segment
    capture is sum_x a_x w_xp^2 over its clusters; no component is taken before the one it follows.
    """
    weights = checked_vertex_weights(vertex_weights, len(model.squared_error_per_vertex))
    gains = [
        # over clusters of different spectra the sum need not fall
        np.minimum.accumulate(weights @ one.weights.astype(np.float64) ** 2)
        for one in model.models
    ]
    owner = np.repeat(np.arange(len(gains)), [len(gain) for gain in gains])
    best = np.argsort(-np.concatenate(gains), kind="stable")[:total]
    kept = np.bincount(owner[best], minlength=len(gains)).tolist()
    errors = model.squared_error_per_vertex.copy()
    models = []
    for one, n in zip(model.models, kept, strict=True):
        dropped = one.weights[:, n:].astype(np.float64)
        lost = np.einsum("vp,vp->v", dropped, dropped)
        errors += lost
        own = one.squared_error_per_vertex + lost
        models.append(
            replace(
                one,
                components=np.ascontiguousarray(one.components[:, :n]),
                weights=np.ascontiguousarray(one.weights[:, :n]),
                ranks=np.minimum(one.ranks, n).astype(np.int32),
                squared_error_per_vertex=own,
                objective=[*one.objective, float(weights @ own)],
            )
        )
    return replace(
        model,
        models=models,
        objective=[float(weights @ errors)],
        squared_error_per_vertex=errors,
    )


def _leading_dims(
    signal: Float32[F32, "verts dims"], weights: Float64[F64, " verts"], n_dims: int, seed: int
) -> Float32[F32, "dims kept"]:
    """Return the leading principal directions about zero of some vertices, as columns."""
    rng = np.random.default_rng(seed)
    n_sample = min(len(signal), SAMPLE_VERTS)
    sample = np.sort(rng.choice(len(signal), size=n_sample, replace=False))
    rows = signal[sample] * np.sqrt(weights[sample]).astype(np.float32)[:, None]
    gram = np.zeros((signal.shape[1], signal.shape[1]))
    for chunk in row_chunks(rows):
        gram += rows[chunk].T @ rows[chunk]
    return leading_eigenvectors(gram, n_dims)[1].astype(np.float32)


def _in_dims(
    signal: Float32[F32, "verts dims"], dims: Float32[F32, "dims kept"]
) -> tuple[Float32[F32, "verts kept"], Float64[F64, " verts"]]:
    """Return coefficients in the leading directions, and the energy outside of them."""
    inside = np.empty((len(signal), dims.shape[1]), dtype=np.float32)
    outside = np.empty(len(signal))
    for chunk in row_chunks(signal):
        np.matmul(signal[chunk], dims, out=inside[chunk])
        outside[chunk] = row_energy(signal[chunk] - inside[chunk] @ dims.T)
    return inside, outside


def _out_of_dims(model: CpcaModel, dims: Float32[F32, "dims kept"]) -> CpcaModel:
    return replace(model, means=model.means @ dims.T, components=model.components @ dims.T)
