"""Clustered tensor approximation of a glossy transfer tensor [Tsai2006]_ section 5.2.

Three phases: an initial clustering, a clustering phase that alternates between fitting the bases
of each cluster and re-classifying the vertices, and an approximation phase that also updates the
view basis shared by all clusters.

Transfer of three colour channels is one tensor whose view axis holds the channels one under the
other.  They share the view basis; what it leaves of them, channels * R_view rows, is not reduced
further in that mode, so a vertex's one set of weights serves all colours.
"""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I32, Float32, Float64
from prtbake_workers.compress.classify import Pays, reclassify
from prtbake_workers.compress.cluster_factors import (
    ClusterFactors,
    fit_cluster,
    light_step,
    project_light,
    projected_weights,
    rank_zero,
    squared_residuals,
    vertex_basis,
    vertex_step,
)
from prtbake_workers.compress.clusters import members_by_cluster, refill_empty_clusters
from prtbake_workers.compress.coherence import Coherence, CoherentMoves
from prtbake_workers.compress.cta_model import CtaModel, CtaRanks, padded
from prtbake_workers.compress.energy import row_energy_by_chunks
from prtbake_workers.compress.inputs import (
    checked_count,
    checked_signal,
    checked_vertex_weights,
    clipped,
    fitting_clusters,
)
from prtbake_workers.compress.lbg import lbg
from prtbake_workers.compress.monotone import ObjectiveTrace
from prtbake_workers.compress.parallel import map_in_order, same_bytes_on_any_threads
from prtbake_workers.compress.progress import Progress, no_progress
from prtbake_workers.compress.view_basis import (
    initial_view_basis,
    project_view,
    updated_view_basis,
)

__all__ = ["CtaModel", "CtaRanks", "compress_cta"]

# The initial clusters are only a start: more iterations of it win nothing in the end.
INITIAL_ITERATIONS = 5
# Light and vertex steps in each model step.  The second costs a tenth of an iteration and wins
# about as much as the members' next move; a third wins nothing.
SWEEPS = 2
APPROXIMATION_ITERATIONS = 3
CONVERGED = 1e-3


def compress_cta(
    transfer: Float[NDArray[Any], "verts rows coeffs"],
    n_clusters: int,
    ranks: CtaRanks,
    *,
    seed: int,
    max_iterations: int = 10,
    tolerance: float = CONVERGED,
    vertex_weights: NDArray[Any] | None = None,
    n_channels: int = 1,
    coherence: Coherence | None = None,
    progress: Progress = no_progress,
) -> CtaModel:
    """Approximate a transfer tensor by clusters of vertices with a basis for each mode.

    Parameters
    ----------
    transfer
        float32 T, (view, light) matrix of each vertex, in an orthonormal (whitened) basis of the
        light and with orthonormal view functions, so that squared errors are squared radiance
        errors.  A row is a term of the view; with channels, row c * terms + k is term k of channel
        c.
    n_clusters
        Clusters, at least 1; cut to the number of vertices.
    ranks
        (view, light, vert) reduced ranks, at least 1; cut to what the tensor's shape can fill.
        The view rank is that of each channel.
    seed
        Start of the clustering; the same seed and tensor give the same model.
    max_iterations
        Most iterations of the clustering phase.
    tolerance
        Both phases end earlier where no vertex moves or an iteration wins less than this share of
        the error.
    vertex_weights
        Weight of each vertex in the squared error, >= 0, e.g. its area; ones when None.  Vertices
        of weight zero are approximated by what serves the others.
    n_channels
        Colour channels that the rows hold one after the other, at least 1.
    coherence
        Lets vertices pay for being far from their cluster on the mesh: the initial clusters are
        coherent, and a vertex moves only where that does not cost it more than it wins.  None for
        the transfer alone.
    progress
        Called with the fraction done and a word on the state, at most once a step.

    Returns
    -------
    CtaModel
        The same bytes on any number of threads.  Clusters may be fewer than asked for where the
        tensor has too few distinct vertices, and each has its true ranks; ``notes`` says so.

    Raises
    ------
    SettingsError
        For what cannot be used, with the argument as pointer and the vertex in the message.
    ObjectiveRose
        Where the squared error rises between model steps by more than 1e-7 of the squared norm.

    Notes
    -----
    A light basis starts from the last iteration's, so the squared error cannot rise.  An empty
    cluster takes a part of the one with the largest error, along with its bases.
    """
    t = checked_signal(transfer, "transfer", ("verts", "terms", "coeffs"))
    if t.shape[1] % checked_count(n_channels, "n_channels"):
        raise SettingsError(
            f"transfer has {t.shape[1]} rows for n_channels {n_channels}: no whole terms",
            pointer="/n_channels",
        )
    weights = checked_vertex_weights(vertex_weights, len(t))
    notes: list[str] = []
    n_clusters = fitting_clusters(n_clusters, len(t), notes)
    ranks = _fitting_ranks(CtaRanks(*ranks), t, n_channels, notes)
    checked_count(max_iterations, "max_iterations")

    with same_bytes_on_any_threads():
        rng = np.random.default_rng(seed)
        fit = _Fit(
            t, weights, ranks, n_clusters, n_channels, rng, max_iterations, tolerance, coherence
        )
        fit.run(progress)
        return fit.model(seed, notes)


def _fitting_ranks(
    ranks: CtaRanks,
    transfer: Float32[F32, "verts rows coeffs"],
    n_channels: int,
    notes: list[str],
) -> CtaRanks:
    """Return ``ranks`` cut to what a tensor of this shape can have."""
    n_verts, n_rows, n_coeffs = transfer.shape
    n_terms = n_rows // n_channels
    for name, value in zip(ranks._fields, ranks, strict=True):
        checked_count(value, f"ranks/{name}")
    view = clipped(ranks.view, n_terms, "ranks.view", f"{n_terms} terms", notes)
    light = clipped(ranks.light, n_coeffs, "ranks.light", f"{n_coeffs} coefficients", notes)
    span = min(n_verts, n_channels * view * light)
    vert = clipped(ranks.vert, span, "ranks.vert", f"vertices span {span} dimensions", notes)
    return CtaRanks(view, light, vert)


class _Fit:
    """State of the iteration: bases, labels, and the squared error of every vertex.

    ``errors`` is what the clusters' bases leave of Z_view, ``view_errors`` what the view basis
    leaves of T.  They are orthogonal, so their sum is the vertex's squared error.  ``z`` holds the
    r_view rows of each channel, channel by channel.
    """

    def __init__(
        self,
        transfer: Float32[F32, "verts rows coeffs"],
        weights: Float64[F64, " verts"],
        ranks: CtaRanks,
        n_clusters: int,
        n_channels: int,
        rng: np.random.Generator,
        max_iterations: int,
        tolerance: float,
        coherence: Coherence | None,
    ) -> None:
        self.coherence = coherence
        n_verts, n_rows, n_coeffs = transfer.shape
        self.transfer, self.weights, self.ranks = transfer, weights, ranks
        self.n_clusters, self.rng, self.max_iterations = n_clusters, rng, max_iterations
        self.tolerance = tolerance
        self.n_channels = n_channels
        self.root_weights = np.sqrt(weights)
        self.by_channel = transfer.reshape(n_verts * n_channels, n_rows // n_channels, n_coeffs)
        self.view_basis = initial_view_basis(
            self.by_channel, np.repeat(weights, n_channels), ranks.view
        )
        self.z = np.empty((n_verts, n_channels * ranks.view, n_coeffs), dtype=np.float32)
        self.view_errors = self._project_view()
        self.errors = np.zeros(n_verts)
        self.labels: I32 = np.zeros(n_verts, dtype=np.int32)
        self.factors: list[ClusterFactors] = []
        energy = row_energy_by_chunks(transfer.reshape(n_verts, -1))
        self.trace = ObjectiveTrace(float(weights @ energy), "CTA")

    def run(self, progress: Progress) -> None:
        """Run the three phases."""
        n_steps = self.max_iterations + APPROXIMATION_ITERATIONS + 1
        progress(0.0, "initial clusters")
        self.labels = lbg(
            self.z.reshape(len(self.z), -1),
            self.n_clusters,
            rng=self.rng,
            weights=self.weights,
            max_iterations=INITIAL_ITERATIONS,
            coherence=self.coherence,
        ).labels
        for iteration in range(self.max_iterations):
            if iteration > 0:
                if not self.trace.has_time():
                    break
                pays = self._paying_moves()
                if reclassify(self.z, self.factors, self.labels, self.errors, pays) == 0:
                    break
                self._fill_empty_clusters()
            self._fit_clusters()
            progress((iteration + 2) / n_steps, f"clustering, error {self.trace.ratio:.3%}")
            if self.trace.has_converged(self.tolerance):
                break
        for iteration in range(APPROXIMATION_ITERATIONS):
            if not self.trace.has_time():
                break
            self._fit_all_modes()
            done = (self.max_iterations + iteration + 2) / n_steps
            progress(done, f"approximation, error {self.trace.ratio:.3%}")
            if self.trace.has_converged(self.tolerance):
                break
        progress(1.0, f"error {self.trace.ratio:.3%}")

    def _project_view(self) -> F64:
        """Bring ``z`` up to date with the view basis; return what that leaves of each vertex."""
        z = self.z.reshape(len(self.by_channel), self.ranks.view, -1)
        left_out = project_view(self.by_channel, self.view_basis, z)
        return np.asarray(left_out.reshape(len(self.z), self.n_channels).sum(axis=1))

    def _paying_moves(self) -> Pays | None:
        """Return what lets vertices move where E of [Chen2005]_ eq. (9) falls."""
        if self.coherence is None or self.trace.squared_norm == 0.0:
            return None
        unit = float(np.sqrt(self.trace.squared_norm / self.weights.sum()))
        return CoherentMoves(self.coherence, self.labels, self.n_clusters, self.errors, unit).pays

    def _members(self) -> list[I32]:
        return members_by_cluster(self.labels, self.n_clusters)

    def _roots_of(self, verts: I32) -> F64:
        """Square roots of the vertices' weights; ones for a cluster that weighs nothing."""
        roots = self.root_weights[verts]
        return roots if roots.any() else np.ones(len(verts))

    def _fit_clusters(self) -> None:
        """Model step of the clustering phase: U_light,c and V_c of every cluster."""
        members = self._members()

        def fit(cluster: int) -> ClusterFactors:
            verts = members[cluster]
            if len(verts) == 0:
                return rank_zero(self.z.shape[2])
            factors, self.errors[verts] = fit_cluster(
                self.z[verts],
                self._roots_of(verts),
                self.ranks.light,
                self.ranks.vert,
                start=self.factors[cluster] if self.factors else None,
                sweeps=SWEEPS,
            )
            return factors

        self.factors = map_in_order(fit, range(self.n_clusters))
        self._record()

    def _fit_all_modes(self) -> None:
        """Model step of the approximation phase: U_view, then U_light,c and V_c."""
        members = self._members()

        def basis(cluster: int) -> F64:
            verts = members[cluster]
            weights = projected_weights(self.z[verts], self.factors[cluster])
            return vertex_basis(weights, self._roots_of(verts))

        def fit(cluster: int) -> ClusterFactors:
            verts = members[cluster]
            if len(verts) == 0:
                return rank_zero(self.z.shape[2])
            z, roots = self.z[verts], self._roots_of(verts)
            light = light_step(z, vertex_bases[cluster], roots, self.ranks.light)
            projected = project_light(z, light)
            factors = ClusterFactors(light, vertex_step(projected, roots, self.ranks.vert))
            self.errors[verts] = squared_residuals(z, factors, projected)
            return factors

        vertex_bases = map_in_order(basis, range(self.n_clusters))
        self.view_basis = updated_view_basis(
            self.transfer,
            members,
            vertex_bases,
            self.factors,
            self.root_weights,
            self.ranks.view,
            self.n_channels,
        )
        self.view_errors = self._project_view()
        self.factors = map_in_order(fit, range(self.n_clusters))
        self._record()

    def _record(self) -> None:
        self.trace.append(float(self.weights @ (self.view_errors + self.errors)))

    def _fill_empty_clusters(self) -> None:
        """Give every empty cluster a part of the worst one, and that one's bases."""
        rows = self.z.reshape(len(self.z), -1)
        for cluster, donor in refill_empty_clusters(
            rows, self.labels, self.errors, self.weights, self.n_clusters
        ):
            self.factors[cluster] = self.factors[donor]

    def model(self, seed: int, notes: list[str]) -> CtaModel:
        """Return the fitted model without empty clusters."""
        used, labels = np.unique(self.labels, return_inverse=True)
        if len(used) < self.n_clusters:
            left_out = self.n_clusters - len(used)
            notes.append(f"{left_out} clusters left out: too few distinct vertices")
        n_rows = self.z.shape[1]
        factors = [self.factors[index] for index in used]
        light, dual = padded(factors, n_rows, self.ranks)
        weights = np.zeros((len(self.z), self.ranks.vert), dtype=np.float32)
        ranks = np.zeros((len(used), 3), dtype=np.int32)
        members = members_by_cluster(labels.astype(np.int32), len(used))
        for index, (own, verts) in enumerate(zip(factors, members, strict=True)):
            ranks[index] = self.ranks.view, own.light.shape[1], len(own.dual)
            weights[verts, : len(own.dual)] = projected_weights(self.z[verts], own)
        return CtaModel(
            view_basis=self.view_basis,
            light_bases=light,
            dual_bases=dual,
            weights=weights,
            labels=labels.astype(np.int32),
            ranks=ranks,
            objective=self.trace.values,
            initial_energy=self.trace.squared_norm,
            squared_error_per_vertex=self.view_errors + self.errors,
            iterations=len(self.trace.values),
            seed=seed,
            n_channels=self.n_channels,
            notes=notes,
        )
