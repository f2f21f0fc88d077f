"""Clustered principal component analysis of a diffuse transfer signal [Sloan2003]_ section 4.

Three methods, each beginning with the one before: ``static`` clusters vertices by the distance to
their cluster's mean and fits one PCA in each cluster afterwards, ``iterative`` clusters them by the
error that the components leave, ``adaptive`` gives clusters as many components as pay there.
"""

from collections.abc import Collection
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress import gram_eigh, power_iteration
from prtbake_workers.compress.affine_clusters import AffineClusters, RowSpace, projected_weights
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.coherence import Coherence
from prtbake_workers.compress.cpca_adaptive import adapt
from prtbake_workers.compress.cpca_iterative import iterate
from prtbake_workers.compress.cpca_model import CpcaModel
from prtbake_workers.compress.energy import row_energy_by_chunks
from prtbake_workers.compress.inputs import (
    checked_count,
    checked_signal,
    checked_vertex_weights,
    fitting_clusters,
    fitting_components,
)
from prtbake_workers.compress.lbg import lbg
from prtbake_workers.compress.monotone import ObjectiveTrace
from prtbake_workers.compress.parallel import same_bytes_on_any_threads
from prtbake_workers.compress.progress import Progress, no_progress

__all__ = ["BACK_ENDS", "METHODS", "CpcaModel", "compress_cpca"]

METHODS = ("static", "iterative", "adaptive")
BACK_ENDS: dict[str, RowSpace] = {
    "gram_eigh": gram_eigh.leading_row_space,
    "power_iteration": power_iteration.leading_row_space,
}
# Of the time that the clustering by means and the iterations take, about.
MEANS_SHARE = {"iterative": 0.1, "adaptive": 0.05}
ITERATIONS_SHARE = {"iterative": 0.9, "adaptive": 0.65}


def compress_cpca(
    signal: Float[NDArray[Any], "verts dims"],
    n_clusters: int,
    n_components: int,
    *,
    method: str = "static",
    seed: int,
    max_iterations: int = 40,
    vertex_weights: NDArray[Any] | None = None,
    back_end: str = "gram_eigh",
    coherence: Coherence | None = None,
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
        ``static``: classification by distance to the mean.  ``iterative``: by approximation error,
        components added one by one ([Sloan2003]_ 4.2).  ``adaptive``: the components then
        distributed over the clusters ([Sloan2003]_ 4.3), ``n_components`` in the mean: the same
        storage, and up to four times as many in a cluster.
    seed
        Start of the clustering; the same seed and signal give the same model.
    max_iterations
        Most clustering iterations: by means, then for each number of components, then of the
        distribution.  All end earlier when no vertex moves or one wins little.
    vertex_weights
        Weight of each vertex in the squared error, >= 0, e.g. its area; ones when None.  Vertices
        of weight zero are approximated by what serves the others.
    back_end
        How principal components are found: ``gram_eigh`` decomposes Gram matrices,
        ``power_iteration`` takes one vector after the other, slower ([Miandji2011]_ appendix).
    coherence
        Lets vertices pay for being far from their cluster on the mesh, in the clustering by means
        and by error; None for the signal alone.
    progress
        Called with the fraction done and a word on the state, at most once an iteration.

    Returns
    -------
    CpcaModel
        The same bytes on any number of threads.  With the same arguments the squared error of
        ``iterative`` is at most that of ``static``, from whose clusters it starts (and again from
        its components, should it end above it), and that of ``adaptive`` at most that of
        ``iterative``, of which it takes only steps that lower it, at no more bytes.

    Raises
    ------
    SettingsError
        For what cannot be used, with the argument as pointer and the vertex in the message.
    ObjectiveRose
        Where the squared error rises between model steps by more than 1e-7 of the squared norm.
    """
    _known(method, METHODS, "method", "CPCA method")
    _known(back_end, BACK_ENDS, "back_end", "PCA back end")
    x = checked_signal(signal, "signal", ("verts", "dims"))
    n_verts = len(x)
    weights = checked_vertex_weights(vertex_weights, n_verts)
    notes: list[str] = []
    n_clusters = fitting_clusters(n_clusters, n_verts, notes)
    n_components = fitting_components(n_components, x, notes)
    checked_count(max_iterations, "max_iterations")

    with same_bytes_on_any_threads():
        row_space = BACK_ENDS[back_end]
        fit = _Fit(x, weights, method, row_space, max_iterations, coherence, progress)
        clusters = fit.run(n_clusters, n_components, seed)
        model = _model(clusters, fit.trace, n_components, seed, notes)
        if model.n_clusters < n_clusters:
            left_out = n_clusters - model.n_clusters
            notes.append(f"{left_out} clusters left out: too few distinct vertices")
        return model


def _known(value: str, known: Collection[str], name: str, what: str) -> None:
    if value not in known:
        raise SettingsError(
            f"{what} {value!r} is not available; use {', '.join(map(repr, known))}",
            pointer=f"/{name}",
        )


class _Fit:
    """Runs one method, and keeps the objective."""

    def __init__(
        self,
        x: Float32[F32, "verts dims"],
        weights: Float64[F64, " verts"],
        method: str,
        row_space: RowSpace,
        max_iterations: int,
        coherence: Coherence | None,
        progress: Progress,
    ) -> None:
        self.x, self.weights, self.method, self.row_space = x, weights, method, row_space
        self.max_iterations, self.progress = max_iterations, progress
        self.coherence = coherence
        energy = float(weights @ row_energy_by_chunks(x))
        self.trace = ObjectiveTrace(energy, "CPCA", may_rise=coherence is not None)

    def run(self, n_clusters: int, n_components: int, seed: int) -> AffineClusters:
        """Cluster by means, then as the method does."""
        # the components of the static method cost about as much as one iteration
        by_means = MEANS_SHARE.get(self.method, self.max_iterations / (self.max_iterations + 1))
        clusters = self._by_means(n_clusters, n_components, seed, self._part(0.0, by_means))
        if self.method == "static":
            clusters.use(np.full(clusters.n_clusters, n_components))
            self.trace.append(clusters.squared_error)
        else:
            iterated = by_means + ITERATIONS_SHARE[self.method] * (1.0 - by_means)
            part = self._part(by_means, iterated)
            clusters = iterate(clusters, n_components, self.trace, self.max_iterations, part)
            if self.method == "adaptive":
                clusters = adapt(
                    clusters, self.trace, self.max_iterations, self._part(iterated, 1.0)
                )
        self.progress(1.0, f"error {self.trace.ratio:.3%}")
        return clusters

    def _by_means(
        self, n_clusters: int, n_components: int, seed: int, progress: Progress
    ) -> AffineClusters:
        """Cluster by the distance to the means, and find each cluster's components."""
        self.progress(0.0, "initial clusters")
        found = lbg(
            self.x,
            n_clusters,
            rng=np.random.default_rng(seed),
            weights=self.weights,
            max_iterations=self.max_iterations,
            coherence=self.coherence,
            progress=progress,
        )
        for value in found.objective:
            self.trace.append(value)
        used, labels = np.unique(found.labels, return_inverse=True)
        clusters = AffineClusters(
            self.x,
            self.weights,
            labels.astype(np.int32),
            len(used),
            depth=n_components,
            row_space=self.row_space,
            coherence=self.coherence,
        )
        clusters.find_components()
        return clusters

    def _part(self, start: float, stop: float) -> Progress:
        """Return a progress of a stretch of this one, whose end is the next one's start."""

        def progress(fraction: float, state: str) -> None:
            if fraction < 1.0 or stop < 1.0:
                self.progress(start + fraction * (stop - start), state)

        return progress


def _model(
    clusters: AffineClusters,
    trace: ObjectiveTrace,
    n_components: int,
    seed: int,
    notes: list[str],
) -> CpcaModel:
    """Return what the clusters hold, as arrays padded to the largest rank."""
    used, labels = np.unique(clusters.labels, return_inverse=True)
    subspaces = [clusters.subspaces[cluster] for cluster in used]
    n_verts, n_dims = clusters.signal.shape
    ranks = np.array([len(subspace.basis) for subspace in subspaces], dtype=np.int32)
    width = max(n_components, int(ranks.max()))
    components = np.zeros((len(used), width, n_dims), dtype=np.float32)
    weights = np.zeros((n_verts, width), dtype=np.float32)
    members = members_by_cluster(labels.astype(np.int32), len(used))
    for cluster, (verts, subspace) in enumerate(zip(members, subspaces, strict=True)):
        components[cluster, : ranks[cluster]] = subspace.basis
        weights[verts, : ranks[cluster]] = projected_weights(clusters.signal[verts], subspace)
    return CpcaModel(
        means=np.array([subspace.mean for subspace in subspaces]),
        components=components,
        weights=weights,
        labels=labels.astype(np.int32),
        ranks=ranks,
        objective=trace.values,
        initial_energy=trace.squared_norm,
        squared_error_per_vertex=clusters.errors,
        iterations=len(trace.values) - 1,
        seed=seed,
        notes=notes,
    )
