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
from prtbake_workers.compress.gram_eigh import nearer_row_space, orthonormal_rows
from prtbake_workers.compress.inputs import checked_count, checked_signal, checked_vertex_weights
from prtbake_workers.compress.progress import Progress, no_progress
from prtbake_workers.compress.rank_allocation import allocate_ranks
from prtbake_workers.compress.trim import column_energies, without_columns
from prtbake_workers.compress.view_basis import project_view

N_FACES = 6
SAMPLE_VERTS = 4096
"""The leading dimensions of a segment are those of so many vertices, drawn at random."""

DIM_ITERATIONS = 2
"""Orthogonal iterations from random directions: what they miss of thousands counts as error, and is
a share of what lies outside anyway."""


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
    n_dims: int | Sequence[int] | None = None,
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
        Clusters and components are sought in so many leading dimensions of each segment, one number
        for all or one for each; None in all of them, which takes far longer.  What lies outside is
        part of the error.
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
    dims_of: Sequence[int | None] = (
        [n_dims] * len(segments) if n_dims is None or isinstance(n_dims, int) else list(n_dims)
    )
    models: list[CpcaModel] = []
    weights, errors, energy = np.zeros(0), np.zeros(0), np.zeros(0)
    for part, texels, count, most in zip(parts, segments, counts, dims_of, strict=True):
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
        if most is not None and most < signal.shape[1]:
            dims = _leading_dims(signal, weights, checked_count(most, "n_dims"), seed)
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


def spend_numbers(
    model: SegmentedCpcaModel,
    budget: float,
    *,
    column_numbers: float = 0.0,
    vertex_weights: Float64[F64, " verts"] | None = None,
) -> SegmentedCpcaModel:
    """Keep the components that capture most in ``budget`` numbers, a cluster at a time.

    [Liu2004]_ gives every segment as many; half of the light of an object on a plane carries next
    to nothing, and clusters of one segment differ too.

    Parameters
    ----------
    model
        With as many components in each segment as its richest cluster may need.
    budget
        Numbers of components and weights together, at least 0; means are kept all.
    column_numbers
        That a component stores beside its own and its vertices' weights, such as scales.
    vertex_weights
        Those that it was compressed with.

    Notes
    -----
    Components of a cluster are orthonormal, strongest first: what the p-th one captures is
    sum_x a_x w_xp^2 over the cluster, and no component is taken before the one it follows.
    """
    weights = checked_vertex_weights(vertex_weights, len(model.squared_error_per_vertex))
    gains: list[F64] = []
    costs: list[float] = []
    for one in model.models:
        energies = column_energies(one.weights, one.labels, one.n_clusters, weights)
        for own, rank in zip(energies, one.ranks, strict=True):
            # falling but for rounding, which a path that takes them in order cannot follow
            gains.append(np.minimum.accumulate(own[:rank]))
        sizes = np.bincount(one.labels, minlength=one.n_clusters)
        costs += (sizes + one.means.shape[1] + column_numbers).tolist()
    ranks = allocate_ranks(gains, np.array(costs), budget).ranks
    ends = np.cumsum([one.n_clusters for one in model.models])[:-1]
    return _kept(model, np.split(ranks, ends), weights)


def even_components(
    model: SegmentedCpcaModel,
    budget: float,
    *,
    column_numbers: float = 0.0,
    vertex_weights: Float64[F64, " verts"] | None = None,
) -> SegmentedCpcaModel:
    """Keep as many components in every cluster of every segment, as [Liu2004]_ does.

    The last round goes to the segments of most energy, while it fits.  Parameters are those of
    `spend_numbers`.
    """
    weights = checked_vertex_weights(vertex_weights, len(model.squared_error_per_vertex))
    order = np.argsort([-one.initial_energy for one in model.models], kind="stable").tolist()
    kept = [np.zeros(one.n_clusters, dtype=np.int64) for one in model.models]
    for n in range(1, 1 + max(one.weights.shape[1] for one in model.models)):
        for index in order:
            one = model.models[index]
            own = np.minimum(one.ranks, n).astype(np.int64)
            sizes = np.bincount(one.labels, minlength=one.n_clusters)
            cost = (own - kept[index]) @ (sizes + one.means.shape[1] + column_numbers)
            if cost > budget:
                return _kept(model, kept, weights)
            budget -= cost
            kept[index] = own
    return _kept(model, kept, weights)


def _kept(model: SegmentedCpcaModel, ranks: Sequence[I64], weights: F64) -> SegmentedCpcaModel:
    """Keep the first components of each cluster of each segment."""
    models = []
    errors = model.squared_error_per_vertex.copy()
    for one, own in zip(model.models, ranks, strict=True):
        columns = np.arange(one.weights.shape[1])
        left_out = (columns >= own[:, None]) & (columns < one.ranks[:, None])
        less = without_columns(one, left_out, weights)
        assert isinstance(less, CpcaModel)
        errors += less.squared_error_per_vertex - one.squared_error_per_vertex
        models.append(less)
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
    rows = signal[sample].astype(np.float64) * np.sqrt(weights[sample])[:, None]
    found = orthonormal_rows(rng.standard_normal((n_dims, signal.shape[1])))
    for _ in range(DIM_ITERATIONS):
        found = nearer_row_space(rows, found)
    return found.T.astype(np.float32)


def _in_dims(
    signal: Float32[F32, "verts dims"], dims: Float32[F32, "dims kept"]
) -> tuple[Float32[F32, "verts kept"], Float64[F64, " verts"]]:
    """Return coefficients in the leading directions, and the energy outside of them."""
    inside = np.empty((len(signal), dims.shape[1]), dtype=np.float32)
    outside = np.empty(len(signal))
    for chunk in row_chunks(signal):
        np.matmul(signal[chunk], dims, out=inside[chunk])
        # of a thousandth of the energy the difference has lost three digits of seven
        outside[chunk] = row_energy(signal[chunk]) - row_energy(inside[chunk])
    return inside, np.maximum(outside, 0.0)


def _out_of_dims(model: CpcaModel, dims: Float32[F32, "dims kept"]) -> CpcaModel:
    return replace(model, means=model.means @ dims.T, components=model.components @ dims.T)
