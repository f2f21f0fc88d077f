"""Clustered principal component analysis of a diffuse transfer signal [Sloan2003]_ section 4.

The static method: vertices are clustered by the distance to their cluster's mean, and one PCA is
fitted in each cluster afterwards.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.energy import row_energy, row_energy_by_chunks
from prtbake_workers.compress.gram_eigh import leading_row_space
from prtbake_workers.compress.inputs import (
    checked_count,
    checked_signal,
    checked_vertex_weights,
    clipped,
)
from prtbake_workers.compress.lbg import lbg
from prtbake_workers.compress.monotone import ObjectiveTrace
from prtbake_workers.compress.parallel import map_in_order, same_bytes_on_any_threads
from prtbake_workers.compress.progress import Progress, no_progress

METHODS = ("static",)


def compress_cpca(
    signal: Float[NDArray[Any], "verts dims"],
    n_clusters: int,
    n_components: int,
    *,
    method: str = "static",
    seed: int,
    max_iterations: int = 40,
    vertex_weights: NDArray[Any] | None = None,
    progress: Progress = no_progress,
) -> CpcaModel:
    """Approximate each row of ``signal`` by its cluster's mean and principal components.

    Parameters
    ----------
    signal
        float32 coefficients of each vertex in an orthonormal (whitened) basis, so that squared
        errors are squared radiance errors.
    n_clusters, n_components
        Clusters and components in each, at least 1; cut to what the signal can fill.
    method
        ``static``: classification by distance to the mean.
    seed
        Start of the clustering; the same seed and signal give the same model.
    max_iterations
        Most clustering iterations.
    vertex_weights
        Weight of each vertex in the squared error, >= 0, e.g. its area; ones when None.  Vertices
        of weight zero are approximated by what serves the others.
    progress
        Called with the fraction done and a word on the state, once an iteration.

    Raises
    ------
    SettingsError
        For what cannot be used, with the argument as pointer and the vertex in the message.

    Notes
    -----
    [Sloan2003]_ keeps a cluster's squared error as |x - x0|^2 minus the squared weights; here it
    is taken from the residual itself, which stays exact when it is small.
    """
    if method not in METHODS:
        raise SettingsError(
            f"CPCA method {method!r} is not available; use {', '.join(map(repr, METHODS))}",
            pointer="/method",
        )
    x = checked_signal(signal, "signal", ("verts", "dims"))
    n_verts, n_dims = x.shape
    weights = checked_vertex_weights(vertex_weights, n_verts)
    notes: list[str] = []
    n_clusters = clipped(
        checked_count(n_clusters, "n_clusters"),
        n_verts,
        "n_clusters",
        "one vertex a cluster at least",
        notes,
    )
    n_components = clipped(
        checked_count(n_components, "n_components"),
        min(n_dims, n_verts),
        "n_components",
        f"{n_verts} vertices of {n_dims} dimensions span no more",
        notes,
    )
    checked_count(max_iterations, "max_iterations")

    with same_bytes_on_any_threads():
        return _fit(x, weights, n_clusters, n_components, seed, max_iterations, notes, progress)


def _fit(
    x: Float32[F32, "verts dims"],
    weights: Float64[F64, " verts"],
    n_clusters: int,
    n_components: int,
    seed: int,
    max_iterations: int,
    notes: list[str],
    progress: Progress,
) -> CpcaModel:
    """Cluster, then fit a PCA in each cluster."""
    progress(0.0, "initial clusters")
    clusters = lbg(
        x,
        n_clusters,
        rng=np.random.default_rng(seed),
        weights=weights,
        max_iterations=max_iterations,
        # the components cost about as much as one iteration
        progress=lambda done, state: progress(done * max_iterations / (max_iterations + 1), state),
    )
    used, labels = np.unique(clusters.labels, return_inverse=True)
    if len(used) < n_clusters:
        notes.append(f"{n_clusters - len(used)} clusters left out: too few distinct vertices")
    model = _fit_components(x, labels.astype(np.int32), clusters.means[used], n_components, weights)
    components, vertex_coefficients, ranks, errors = model

    trace = ObjectiveTrace(float(weights @ row_energy_by_chunks(x)), "CPCA")
    for value in (*clusters.objective, float(weights @ errors)):
        trace.append(value)
    progress(1.0, f"error {trace.ratio:.3%}")
    return CpcaModel(
        means=clusters.means[used],
        components=components,
        weights=vertex_coefficients,
        labels=labels.astype(np.int32),
        ranks=ranks,
        objective=trace.values,
        initial_energy=trace.squared_norm,
        squared_error_per_vertex=errors,
        iterations=len(clusters.objective),
        seed=seed,
        notes=notes,
    )


def _fit_components(
    x: Float32[F32, "verts dims"],
    labels: Int32[I32, " verts"],
    means: Float32[F32, "clusters dims"],
    n_components: int,
    weights: Float64[F64, " verts"],
) -> tuple[
    Float32[F32, "clusters pcs dims"],
    Float32[F32, "verts pcs"],
    Int32[I32, " clusters"],
    Float64[F64, " verts"],
]:
    """Fit a PCA in each cluster; return components, weights, ranks and squared errors."""
    n_verts, n_dims = x.shape
    components = np.zeros((len(means), n_components, n_dims), dtype=np.float32)
    coefficients = np.zeros((n_verts, n_components), dtype=np.float32)
    ranks = np.zeros(len(means), dtype=np.int32)
    errors = np.zeros(n_verts)
    members_of = members_by_cluster(labels, len(means))

    def fit(cluster: int) -> None:
        members = members_of[cluster]
        centred = x[members] - means[cluster]
        row_scale = np.sqrt(weights[members] if weights[members].any() else 1.0)
        scaled = centred.astype(np.float64) * np.reshape(row_scale, (-1, 1))
        basis = leading_row_space(scaled, n_components).astype(np.float32)
        rank = len(basis)
        projected = centred @ basis.T
        components[cluster, :rank] = basis
        coefficients[members, :rank] = projected
        ranks[cluster] = rank
        errors[members] = row_energy(centred - projected @ basis)

    map_in_order(fit, range(len(means)))
    return components, coefficients, ranks, errors
