"""Clustered tensor approximation with ranks chosen a cluster at a time, at the same storage in all.

[Tsai2006]_ gives every cluster the same ranks.  Clusters in even light need few of them, those
where shadows meet need many.  What [Sloan2003]_ section 4.3 does for components of clustered PCA is
done here for the three ranks of a tensor.
"""

import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I32, I64
from prtbake_workers.compress.cluster_factors import (
    ClusterFactors,
    fit_cluster,
    initial_light_basis,
    project_light,
    projected_weights,
    rank_zero,
    squared_residuals,
    vertex_step,
)
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.cta_model import CtaModel, CtaRanks, padded
from prtbake_workers.compress.gram_eigh import leading_row_space
from prtbake_workers.compress.inputs import checked_rows, checked_vertex_weights
from prtbake_workers.compress.parallel import map_in_order, same_bytes_on_any_threads
from prtbake_workers.compress.progress import Progress, no_progress
from prtbake_workers.compress.rows import Rows
from prtbake_workers.compress.tensor_ranks import RankChoices, allocate_tensor_ranks, rank_choices
from prtbake_workers.compress.view_basis import ProjectedRows, project_view
from prtbake_workers.deadline import time_for

MOST_OVER_BEFORE = 2
"""Light and vertex ranks that a cluster may have, over those that all had before: decoders hold as
many columns for every cluster as the largest has."""

SWEEPS = 2
"""Light and vertex steps at the ranks chosen: a higher-order SVD cut down is near the best."""


def with_own_ranks(
    model: CtaModel,
    transfer: NDArray[Any] | Rows,
    *,
    vertex_weights: NDArray[Any] | None = None,
    progress: Progress = no_progress,
) -> CtaModel:
    """Give each cluster the ranks that are worth most there.

    Parameters
    ----------
    model, transfer
        The model, and the float32 tensor (verts, rows, coeffs) that it was made from.
    vertex_weights
        Those that the model was made with; ones when None.
    progress
        Called with the fraction done and a word on the state.

    Returns
    -------
    CtaModel
        At most as many numbers and no more error: ``model`` itself where no other ranks do better,
        or a deadline leaves no time for all clusters.
        View ranks are at most those of ``model``, whose view basis it keeps: a cluster of view rank
        r uses the first r columns.  A cluster that weighs nothing has no ranks.

    Raises
    ------
    SettingsError
        For a tensor that the model is not of.
    """
    t = checked_rows(transfer, "transfer", ("verts", "rows", "coeffs"))
    weights = checked_vertex_weights(vertex_weights, len(t))
    if len(t) != len(model.labels):
        raise SettingsError(
            f"transfer has {len(t)} vertices, the model {len(model.labels)}", pointer="/transfer"
        )
    with same_bytes_on_any_threads():
        progress(0.0, "own ranks")
        tensor = _Tensor(model, t, weights)
        members = members_by_cluster(model.labels, model.n_clusters)
        if not time_for(model.n_clusters * _seconds_of(tensor, max(members, key=len))):
            return model
        found = map_in_order(tensor.choices, members)
        chosen = allocate_tensor_ranks([own for own, _ in found], tensor.budget).ranks
        progress(0.5, "fits at own ranks")

        def fit(cluster: int) -> tuple[ClusterFactors, F64]:
            return tensor.fitted(members[cluster], chosen[cluster], found[cluster][1])

        fits = map_in_order(fit, range(model.n_clusters))
        errors = tensor.view_errors.copy()
        for verts, (_, left) in zip(members, fits, strict=True):
            errors[verts] += left
        error = float(weights @ errors)
        progress(1.0, "own ranks")
        if error >= model.squared_error_ratio * model.initial_energy:
            return model
        ranks = chosen.astype(np.int32)
        for own, (factors, _) in zip(ranks, fits, strict=True):
            own[1:] = factors.light.shape[1], len(factors.dual)
        width = CtaRanks(*np.maximum(1, ranks.max(axis=0)).tolist())
        light, dual = padded([factors for factors, _ in fits], tensor.z.shape[1], width)
        projected = np.zeros((len(t), width.vert), np.float32)
        for verts, (factors, _) in zip(members, fits, strict=True):
            projected[verts, : len(factors.dual)] = projected_weights(tensor.z[verts], factors)
    return replace(
        model,
        light_bases=light,
        dual_bases=dual,
        weights=projected,
        ranks=ranks,
        objective=[*model.objective, error],
        squared_error_per_vertex=errors,
        iterations=model.iterations + 1,
        trimmed=0.0,
    )


def _seconds_of(tensor: "_Tensor", verts: I32) -> float:
    """Try what a cluster takes: its choices, and a fit about as long."""
    began = time.monotonic()
    tensor.choices(verts)
    return 2.0 * (time.monotonic() - began)


class _Tensor:
    """What all clusters are fitted to: Z_view, weights, and the storage there is."""

    def __init__(self, model: CtaModel, t: Rows, weights: F64) -> None:
        n_coeffs = t.shape[2]
        self.n_channels, self.r_view = model.n_channels, model.view_basis.shape[1]
        read = ProjectedRows(t, model.view_basis, self.n_channels)
        held = np.empty(read.shape, np.float32) if isinstance(t, np.ndarray) else None
        self.view_errors: F64 = project_view(t, model.view_basis, held, self.n_channels)
        self.z: Rows = read if held is None else held
        self.weights, self.roots = weights, np.sqrt(weights)
        self.budget = model.nbytes / 4 - model.view_basis.size
        self.most_light = min(n_coeffs, MOST_OVER_BEFORE * model.light_bases.shape[2])
        self.most_vert = MOST_OVER_BEFORE * model.weights.shape[1]

    def choices(self, verts: I32) -> tuple[RankChoices, F32]:
        """Return what ranks of these vertices' cluster are worth, and the light basis of most."""
        z, roots = self.z[verts], self.roots[verts]
        light = initial_light_basis(z, roots, self.most_light)
        rows = project_light(z, light).astype(np.float64) * roots[:, None]
        dual = leading_row_space(rows, self.most_vert)
        strengths = np.linalg.norm(rows @ dual.T, axis=0)
        core = (dual * strengths[:, None]).reshape(
            len(dual), self.n_channels, self.r_view, light.shape[1]
        )
        return rank_choices(core, len(verts), z.shape[2]), light

    def fitted(self, verts: I32, ranks: I64, light: F32) -> tuple[ClusterFactors, F64]:
        """Fit a cluster at its ranks, from the leading columns of a light basis."""
        view, r_light, r_vert = ranks.tolist()
        z, roots = self.z[verts], self.roots[verts]
        n_verts, n_rows, n_coeffs = z.shape
        factors = rank_zero(n_coeffs)
        if r_vert > 0:
            by_channel = z.reshape(n_verts, self.n_channels, self.r_view, n_coeffs)
            seen = np.ascontiguousarray(by_channel[:, :, :view]).reshape(n_verts, -1, n_coeffs)
            start = np.ascontiguousarray(light[:, :r_light])
            dual = vertex_step(project_light(seen, start), roots, r_vert)
            found, _ = fit_cluster(
                seen, roots, r_light, r_vert, start=ClusterFactors(start, dual), sweeps=SWEEPS
            )
            r_vert, r_light = len(found.dual), found.light.shape[1]
            whole = np.zeros((r_vert, self.n_channels, self.r_view, r_light), np.float32)
            whole[:, :, :view] = found.dual.reshape(r_vert, self.n_channels, view, r_light)
            factors = ClusterFactors(found.light, whole.reshape(r_vert, n_rows * r_light))
        return factors, squared_residuals(z, factors)
