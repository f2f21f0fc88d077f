"""Compressed models with fewer draws for a little more error.

The search of `reclassify_overdraw` on clusters whose bases stay as they are; a clustered PCA is
then fitted anew to its members, which wins error back, and searched again while that lets more
vertices move.  What the last fit won is not spent: vertices then settle, moving only where neither
error nor draws rise.  Whatever is refitted, the squared error never exceeds the budget.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int32
from prtbake_workers.compress.cluster_factors import (
    projected_weights,
    squared_residuals,
)
from prtbake_workers.compress.clusters import members_by_cluster, weighted_mean
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.cta_model import CtaModel, unpadded
from prtbake_workers.compress.energy import row_energy
from prtbake_workers.compress.gram_eigh import leading_row_space
from prtbake_workers.compress.inputs import checked_rows, checked_signal, checked_vertex_weights
from prtbake_workers.compress.parallel import map_in_order, same_bytes_on_any_threads
from prtbake_workers.compress.reclassify_overdraw import BUDGET, reclassify_for_overdraw
from prtbake_workers.compress.rows import Rows
from prtbake_workers.compress.view_basis import project_view

ROUNDS = 4
"""Searches of a clustered PCA, each after a fit.  On the dino in 256 clusters the third and fourth
still took an eighth of the overdraw beyond one."""

MOST_SETTLING_ROUNDS = 10
"""Searches after these, in which no error is spent; two to five on the models of [Chen2005]_."""

SETTLED = 1e-3
"""Share of the squared error that a settling round must win to be followed by another."""


def less_overdraw_cpca(
    model: CpcaModel,
    signal: Float[NDArray[Any], "verts dims"],
    faces: Int32[I32, "tris 3"],
    *,
    budget: float = BUDGET,
    vertex_weights: NDArray[Any] | None = None,
    rounds: int = ROUNDS,
) -> CpcaModel:
    """Move vertices of a clustered PCA to neighbouring clusters and fit these anew.

    Parameters
    ----------
    model, signal
        The model, and the float32 signal that it was made from.
    faces
        Corners of each triangle, indices into the signal's rows.
    budget
        Share of the model's squared error that may be added, >= 0; 0 spends only what moves and
        fits win.
    vertex_weights
        Those that the model was made with.
    rounds
        Searches at most that spend error, at least 1.

    Returns
    -------
    CpcaModel
        Of the same clusters and ranks, with the squared error as the last entry of ``objective``:
        at most (1 + budget) times the one before.  Clusters are fitted anew after every search, and
        vertices settle at the end, until that wins less than ``SETTLED`` of the error.

    Raises
    ------
    SettingsError
        For a negative budget or a signal that the model is not of.
    """
    x = checked_signal(signal, "signal", ("verts", "dims"))
    weights = checked_vertex_weights(vertex_weights, len(x))
    _check(budget, len(x), len(model.labels))
    start = float(weights @ model.squared_error_per_vertex)
    state = _CpcaState(model)

    def errors_in(cluster: int, verts: I64) -> F64:
        centred = x[verts] - state.means[cluster]
        basis = state.components[cluster, : model.ranks[cluster]]
        return row_energy(centred - (centred @ basis.T) @ basis)

    def search(most_error: float) -> bool:
        """Move what there is room for, fit anew, and tell whether anything moved."""
        found = reclassify_for_overdraw(
            faces, state.labels, state.errors, errors_in, weights=weights, most_error=most_error
        )
        touched = np.flatnonzero(found.labels != state.labels)
        changed = np.union1d(found.labels[touched], state.labels[touched])
        state.labels, state.errors = found.labels, found.errors
        state.refit(x, weights, changed)
        return found.n_moves > 0

    with same_bytes_on_any_threads():
        for _ in range(rounds):
            if not search((1.0 + budget) * start):
                break
        for _ in range(MOST_SETTLING_ROUNDS):
            before = float(weights @ state.errors)
            # no room at all: only moves that add no error
            if not search(0.0) or before - float(weights @ state.errors) <= SETTLED * before:
                break
    error = float(weights @ state.errors)
    return replace(
        model,
        means=state.means,
        components=state.components,
        weights=state.coefficients,
        labels=state.labels,
        ranks=state.ranks,
        squared_error_per_vertex=state.errors,
        objective=[*model.objective, error],
    )


class _CpcaState:
    """The arrays of a model while its vertices move."""

    def __init__(self, model: CpcaModel) -> None:
        self.means, self.components = model.means.copy(), model.components.copy()
        self.coefficients, self.labels = model.weights.copy(), model.labels.copy()
        self.errors, self.ranks = model.squared_error_per_vertex.copy(), model.ranks.copy()
        self.most_ranks = model.ranks

    def refit(
        self,
        x: Float32[F32, "verts dims"],
        weights: Float64[F64, " verts"],
        clusters: Int32[I32, " changed"],
    ) -> None:
        """Fit mean and components of clusters to their members, at the ranks they had."""
        members_of = members_by_cluster(self.labels, len(self.means))

        def fit(cluster: int) -> None:
            members = members_of[cluster]
            rows = x[members]
            own = weights[members] if weights[members].any() else np.ones(len(members))
            mean = weighted_mean(rows, own)
            centred: F32 = rows - mean
            scaled = centred.astype(np.float64) * np.sqrt(own)[:, None]
            most = int(self.most_ranks[cluster])
            found = leading_row_space(scaled, most) if most else scaled[:0]
            basis = found.astype(np.float32)
            rank = len(basis)
            projected: F32 = centred @ basis.T
            left: F32 = centred - projected @ basis
            errors = row_energy(left)
            if own @ errors > own @ self.errors[members]:
                # only float32 rounding near a perfect fit makes the best basis worse
                self._project(x, members, cluster)
                return
            self.means[cluster] = mean
            self.components[cluster] = 0.0
            self.components[cluster, :rank] = basis
            self.coefficients[members] = 0.0
            self.coefficients[members, :rank] = projected
            self.ranks[cluster], self.errors[members] = rank, errors

        map_in_order(fit, [int(cluster) for cluster in clusters])

    def _project(self, x: Float32[F32, "verts dims"], members: I32, cluster: int) -> None:
        """Give members their weights in the components as they are."""
        basis = self.components[cluster]
        self.coefficients[members] = (x[members] - self.means[cluster]) @ basis.T


def less_overdraw_cta(
    model: CtaModel,
    transfer: NDArray[Any] | Rows,
    faces: Int32[I32, "tris 3"],
    *,
    budget: float = BUDGET,
    vertex_weights: NDArray[Any] | None = None,
) -> CtaModel:
    """Move vertices of a tensor approximation to neighbouring clusters, whose bases stay.

    Parameters, return value and errors are as of `less_overdraw_cpca`, with the tensor that the
    model was made from, (verts, rows, coeffs).
    """
    t = checked_rows(transfer, "transfer", ("verts", "rows", "coeffs"))
    weights = checked_vertex_weights(vertex_weights, len(t))
    _check(budget, len(t), len(model.labels))
    n_rows, n_coeffs = model.n_channels * model.view_basis.shape[1], t.shape[2]
    factors = unpadded(model)

    def in_view(verts: NDArray[Any]) -> tuple[F32, F64]:
        """Give Z_view of vertices, and what the view basis leaves of them."""
        z = np.empty((len(verts), n_rows, n_coeffs), np.float32)
        return z, project_view(t[verts], model.view_basis, z, model.n_channels)

    def errors_in(cluster: int, verts: I64) -> F64:
        z, left = in_view(verts)
        return squared_residuals(z, factors[cluster]) + left

    with same_bytes_on_any_threads():
        found = reclassify_for_overdraw(
            faces,
            model.labels,
            model.squared_error_per_vertex,
            errors_in,
            weights=weights,
            most_error=(1.0 + budget) * float(weights @ model.squared_error_per_vertex),
        )
        coefficients = model.weights.copy()
        moved = found.labels != model.labels
        for cluster in np.unique(found.labels[moved]).tolist():
            verts = np.flatnonzero(moved & (found.labels == cluster))
            own = projected_weights(in_view(verts)[0], factors[cluster])
            coefficients[verts] = 0.0
            coefficients[verts, : own.shape[1]] = own
    return replace(
        model,
        weights=coefficients,
        labels=found.labels,
        squared_error_per_vertex=found.errors,
        objective=[*model.objective, float(weights @ found.errors)],
    )


def _check(budget: float, n_verts: int, n_labels: int) -> None:
    if not (np.isfinite(budget) and budget >= 0.0):
        raise SettingsError(f"overdraw_budget is {budget}: at least 0", pointer="/overdraw_budget")
    if n_verts != n_labels:
        raise SettingsError(
            f"signal has {n_verts} vertices, the model {n_labels}", pointer="/signal"
        )
