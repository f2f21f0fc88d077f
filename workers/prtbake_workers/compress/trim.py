"""Leave out of a model what it can best do without, until its error is as large as it may be.

Rows of dual bases and principal components are orthonormal within their cluster, so leaving one out
adds just the energy of its weights to the squared error and changes no other weight.  Thousands of
such columns make steps fine enough to land where one wants to.
"""

from dataclasses import replace

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I32, I64, Bool, Float32, Float64, Int32, Int64
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.cta_model import CtaModel

Columns = CpcaModel | CtaModel
"""Models whose vertices weigh orthonormal columns."""


def trimmed(
    model: Columns, allowed: float, vertex_weights: Float64[F64, " verts"] | None = None
) -> Columns:
    """Leave out columns, those of least energy a byte first, until no other fits what is allowed.

    Parameters
    ----------
    model
        Of clustered tensors or of (clustered) PCA.
    allowed
        Squared-error ratio that the result may have; nothing is left out below the model's own.
    vertex_weights
        Those that the model was fitted with; ones when None.

    Returns
    -------
    CpcaModel or CtaModel
        With ``trimmed`` the squared error that the columns held, and fewer ranks.  Columns stay in
        their order; the arrays are as wide as the largest rank left, one at least.
    """
    weights = np.ones(len(model.labels)) if vertex_weights is None else vertex_weights
    energies = column_energies(model.weights, model.labels, model.n_clusters, weights)
    sizes = np.bincount(model.labels, minlength=model.n_clusters)
    slack = (allowed - model.squared_error_ratio) * model.initial_energy
    left_out = _least_worth(energies, _ranks(model), sizes + _row_lengths(model), slack)
    return without_columns(model, left_out, weights) if left_out.any() else model


def without_columns(
    model: Columns,
    left_out: Bool[B8, "clusters columns"],
    vertex_weights: Float64[F64, " verts"],
) -> Columns:
    """Leave out columns of each cluster, and count what they held as ``trimmed``."""
    energies = column_energies(model.weights, model.labels, model.n_clusters, vertex_weights)
    added = np.where(left_out[model.labels], np.square(model.weights, dtype=np.float64), 0.0)
    return replace(
        _without(model, left_out),
        squared_error_per_vertex=model.squared_error_per_vertex + added.sum(axis=1),
        trimmed=model.trimmed + float(energies[left_out].sum()),
    )


def column_energies(
    weights: Float32[F32, "verts columns"],
    labels: Int32[I32, " verts"],
    n_clusters: int,
    vertex_weights: Float64[F64, " verts"],
) -> Float64[F64, "clusters columns"]:
    """Return what each column of each cluster adds to the weighted squared norm."""
    energies = np.empty((n_clusters, weights.shape[1]))
    for column in range(weights.shape[1]):
        squares = np.square(weights[:, column], dtype=np.float64) * vertex_weights
        energies[:, column] = np.bincount(labels, squares, minlength=n_clusters)
    return energies


def _ranks(model: Columns) -> I32:
    """Columns of each cluster."""
    return model.ranks[:, 2] if isinstance(model, CtaModel) else model.ranks


def _row_lengths(model: Columns) -> I32:
    """Floats that a column has in its cluster's basis, beside one for each vertex."""
    if isinstance(model, CtaModel):
        return model.n_channels * model.ranks[:, 0] * model.ranks[:, 1]
    return np.full(model.n_clusters, model.components.shape[2], np.int32)


def _least_worth(
    energies: Float64[F64, "clusters columns"],
    ranks: Int32[I32, " clusters"],
    lengths: Int64[I64, " clusters"],
    slack: float,
) -> Bool[B8, "clusters columns"]:
    """Choose columns that hold no more than the slack together: by energy over length, greedily."""
    left_out = np.zeros(energies.shape, np.bool_)
    cluster, column = np.nonzero(np.arange(energies.shape[1]) < ranks[:, None])
    held = energies[cluster, column]
    for place in np.argsort(held / lengths[cluster], kind="stable"):
        if held[place] <= slack:
            slack -= held[place]
            left_out[cluster[place], column[place]] = True
    return left_out


def _without(model: Columns, left_out: Bool[B8, "clusters columns"]) -> Columns:
    if isinstance(model, CtaModel):
        given, rows, ranks = compacted(
            model.weights, model.dual_bases, model.labels, _ranks(model), left_out
        )
        columns = np.column_stack([model.ranks[:, :2], ranks])
        return replace(model, weights=given, dual_bases=rows, ranks=columns)
    given, rows, ranks = compacted(
        model.weights, model.components, model.labels, model.ranks, left_out
    )
    return replace(model, weights=given, components=rows, ranks=ranks)


def compacted(
    weights: Float32[F32, "verts columns"],
    rows: Float32[F32, "clusters columns numbers"],
    labels: Int32[I32, " verts"],
    ranks: Int32[I32, " clusters"],
    left_out: Bool[B8, "clusters columns"],
) -> tuple[
    Float32[F32, "verts kept"], Float32[F32, "clusters kept numbers"], Int32[I32, " clusters"]
]:
    """Move the columns that stay to the front, and cut the arrays to the largest rank.

    Returns
    -------
    weights, rows, ranks
        As given, with fewer columns; one at least, of zeros where none stays.
    """
    width = left_out.shape[1]
    stays = ~left_out & (np.arange(width) < ranks[:, None])
    kept = stays.sum(axis=1).astype(np.int32)
    width = max(1, int(kept.max(initial=0)))
    order = np.argsort(~stays, axis=1, kind="stable")[:, :width]
    filled = np.arange(width) < kept[:, None]
    given = np.take_along_axis(weights, order[labels], axis=1) * filled[labels]
    own = np.take_along_axis(rows, order[:, :, None], axis=1) * filled[:, :, None]
    return given, own, kept
