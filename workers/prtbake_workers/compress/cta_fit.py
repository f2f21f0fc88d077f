"""The state of a clustered tensor approximation, and its steps, a group of clusters at a time.

A step is made for any clusters by themselves (`better_clusters`, `fitted_clusters`, `view_parts`,
`fitted_in_view`) and taken when all clusters have theirs (`move`, `take_fitted`, `take_view`).
What is made for a cluster reads its own vertices and the state as it was, so it is the same, bit by
bit, whichever process makes it and whatever other clusters it makes.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.compress.classify import Moves, Pays, better_clusters, take_moves
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
from prtbake_workers.compress.lbg import lbg
from prtbake_workers.compress.parallel import map_in_order
from prtbake_workers.compress.rows import Rows, flat
from prtbake_workers.compress.view_basis import (
    ProjectedRows,
    initial_view_basis,
    project_view,
    view_basis_of_grams,
    view_gram_of_cluster,
)

# The initial clusters are only a start: more iterations of it win nothing in the end.
INITIAL_ITERATIONS = 5
# Light and vertex steps in each model step.  The second costs a tenth of an iteration and wins
# about as much as the members' next move; a third wins nothing.
SWEEPS = 2


class Fitted(NamedTuple):
    """A cluster's bases, and what they leave of Z_view of each of its members."""

    factors: ClusterFactors
    errors: Float64[F64, " members"]


class ViewPart(NamedTuple):
    """A cluster's U_vert,c, and its share of the Gram matrix of uf_1(Z_light,vert)."""

    vertex_basis: Float64[F64, "members kept"]
    gram: Float64[F64, "terms terms"]


@dataclass(frozen=True, kw_only=True)
class CtaProblem:
    """What is fitted; no step changes it.

    Attributes
    ----------
    transfer
        T, (verts, rows, coeffs).
    weights
        (verts,) in the squared error.
    ranks
        That the tensor's shape can fill.
    n_clusters, n_channels
        Counts of them.
    coherence
        What distance on the mesh costs, or None.
    """

    transfer: Rows
    weights: Float64[F64, " verts"]
    ranks: CtaRanks
    n_clusters: int
    n_channels: int = 1
    coherence: Coherence | None = None

    @cached_property
    def root_weights(self) -> Float64[F64, " verts"]:
        """Square roots of the weights."""
        return np.asarray(np.sqrt(self.weights))


class CtaFit:
    """State of the iteration: bases, labels, and the squared error of every vertex.

    ``errors`` is what the clusters' bases leave of Z_view, ``view_errors`` what the view basis
    leaves of T.  They are orthogonal, so their sum is the vertex's squared error.  ``z`` holds the
    r_view rows of each channel, channel by channel; where T lies outside of memory, so does Z.

    Parameters
    ----------
    problem
        What is fitted.
    squared_norm
        Of T, weighted.
    view_basis, labels, errors, view_errors, factors
        The state to go on from; without errors and factors, the one before the first model step.
    """

    def __init__(
        self,
        problem: CtaProblem,
        squared_norm: float,
        view_basis: Float32[F32, "terms r_view"],
        labels: Int32[I32, " verts"],
        view_errors: Float64[F64, " verts"],
        errors: Float64[F64, " verts"] | None = None,
        factors: Sequence[ClusterFactors] = (),
    ) -> None:
        self.problem, self.squared_norm = problem, squared_norm
        self.labels, self.view_errors = labels, view_errors
        self.errors = np.zeros(len(labels)) if errors is None else errors
        self.factors = list(factors)
        self.vertex_bases: list[F64] = []
        self.z: Rows = np.empty(0, dtype=np.float32)
        self.set_view_basis(view_basis)

    @classmethod
    def started(cls, problem: CtaProblem, rng: np.random.Generator) -> "CtaFit":
        """Project on the view's leading vectors and cluster what that gives."""
        transfer, weights = problem.transfer, problem.weights
        view = initial_view_basis(transfer, weights, problem.ranks.view, problem.n_channels)
        energy = float(weights @ row_energy_by_chunks(flat(transfer)))
        labels, nothing = np.zeros(len(weights), np.int32), np.zeros(len(weights))
        fit = cls(problem, energy, view, labels, nothing)
        fit.project_view()
        fit.labels = lbg(
            flat(fit.z),
            problem.n_clusters,
            rng=rng,
            weights=weights,
            max_iterations=INITIAL_ITERATIONS,
            coherence=problem.coherence,
        ).labels
        return fit

    def set_view_basis(self, view_basis: Float32[F32, "terms r_view"]) -> None:
        """Set U_view; an array of Z, where T is one, is not filled yet."""
        self.view_basis = view_basis
        projected = ProjectedRows(self.problem.transfer, view_basis, self.problem.n_channels)
        if not isinstance(self.problem.transfer, np.ndarray):
            self.z = projected
        elif self.z.shape != projected.shape:
            self.z = np.empty(projected.shape, dtype=np.float32)

    def project_view(self) -> None:
        """Bring ``z`` and ``view_errors`` up to date with the view basis."""
        out = self.z if isinstance(self.z, np.ndarray) else None
        transfer, n_channels = self.problem.transfer, self.problem.n_channels
        self.view_errors = project_view(transfer, self.view_basis, out, n_channels)

    def view_errors_of(self, verts: I32) -> F64:
        """Return what the view basis leaves of some vertices."""
        transfer = self.problem.transfer[verts]
        return project_view(transfer, self.view_basis, None, self.problem.n_channels)

    @property
    def clusters(self) -> range:
        """Indices of all clusters, empty ones included."""
        return range(self.problem.n_clusters)

    def members(self) -> list[I32]:
        """Return the vertices of each cluster, rising."""
        return members_by_cluster(self.labels, self.problem.n_clusters)

    def objectives(self, clusters: Iterable[int]) -> list[float]:
        """Return the weighted squared error of some clusters."""
        members, weights = self.members(), self.problem.weights

        def objective(verts: I32) -> float:
            return float(weights[verts] @ (self.view_errors[verts] + self.errors[verts]))

        return [objective(members[cluster]) for cluster in clusters]

    def better_clusters(self, clusters: Iterable[int]) -> list[Moves]:
        """Return who is approximated better elsewhere, cluster by cluster."""
        pays = self._paying_moves()
        return better_clusters(self.z, self.factors, self.labels, self.errors, clusters, pays)

    def move(self, moves: Iterable[Moves]) -> int:
        """Move vertices; return how many moved.

        An empty cluster then takes a part of the worst one, and that one's bases.
        """
        n_moved = take_moves(moves, self.labels, self.errors)
        if n_moved == 0:
            return 0
        for cluster, donor in refill_empty_clusters(
            flat(self.z), self.labels, self.errors, self.problem.weights, self.problem.n_clusters
        ):
            self.factors[cluster] = self.factors[donor]
        return n_moved

    def fitted_clusters(self, clusters: Iterable[int]) -> list[Fitted]:
        """Model step of the clustering phase: U_light,c and V_c of some clusters."""
        members, ranks = self.members(), self.problem.ranks

        def fit(cluster: int) -> Fitted:
            verts = members[cluster]
            if len(verts) == 0:
                return Fitted(rank_zero(self.z.shape[2]), np.zeros(0))
            factors, errors = fit_cluster(
                self.z[verts],
                self._roots_of(verts),
                ranks.light,
                ranks.vert,
                start=self.factors[cluster] if self.factors else None,
                sweeps=SWEEPS,
            )
            return Fitted(factors, errors)

        return map_in_order(fit, clusters)

    def take_fitted(self, fitted: Iterable[Fitted]) -> None:
        """Take the bases of all clusters, in their order."""
        self.factors = []
        for verts, (factors, errors) in zip(self.members(), fitted, strict=True):
            self.factors.append(factors)
            self.errors[verts] = errors

    def view_parts(self, clusters: Iterable[int]) -> list[ViewPart]:
        """First half of a model step of the approximation phase, which changes U_view as well."""
        members, n_channels = self.members(), self.problem.n_channels

        def part(cluster: int) -> ViewPart:
            verts, factors = members[cluster], self.factors[cluster]
            roots = self._roots_of(verts)
            basis = vertex_basis(projected_weights(self.z[verts], factors), roots)
            # without the substitutes of `_roots_of`: who weighs nothing has no say in the view
            own = self.problem.root_weights[verts]
            transfer = self.problem.transfer[verts]
            return ViewPart(basis, view_gram_of_cluster(transfer, basis, factors, own, n_channels))

        return map_in_order(part, clusters)

    def take_view(
        self,
        grams: Iterable[Float64[F64, "terms terms"]],
        vertex_bases: Sequence[F64],
    ) -> None:
        """Take the best view basis for the light and vertex bases of all clusters, in order.

        ``vertex_bases`` are (members, kept), and anything for clusters that are not fitted here.
        """
        self.vertex_bases = list(vertex_bases)
        self.set_view_basis(view_basis_of_grams(grams, self.problem.ranks.view))

    def fitted_in_view(self, clusters: Iterable[int]) -> list[Fitted]:
        """Second half: U_light,c and V_c of some clusters in the new view."""
        members, ranks = self.members(), self.problem.ranks

        def fit(cluster: int) -> Fitted:
            verts, basis = members[cluster], self.vertex_bases[cluster]
            if len(verts) == 0:
                return Fitted(rank_zero(self.z.shape[2]), np.zeros(0))
            z, roots = self.z[verts], self._roots_of(verts)
            light = light_step(z, basis, roots, ranks.light)
            projected = project_light(z, light)
            factors = ClusterFactors(light, vertex_step(projected, roots, ranks.vert))
            return Fitted(factors, squared_residuals(z, factors, projected))

        return map_in_order(fit, clusters)

    def _roots_of(self, verts: I32) -> F64:
        """Square roots of the vertices' weights; ones for a cluster that weighs nothing."""
        roots = self.problem.root_weights[verts]
        return roots if roots.any() else np.ones(len(verts))

    def _paying_moves(self) -> Pays | None:
        """Return what lets vertices move where E of [Chen2005]_ eq. (9) falls."""
        coherence = self.problem.coherence
        if coherence is None or self.squared_norm == 0.0:
            return None
        unit = float(np.sqrt(self.squared_norm / self.problem.weights.sum()))
        n_clusters = self.problem.n_clusters
        return CoherentMoves(coherence, self.labels, n_clusters, self.errors, unit).pays

    def model(self, objective: list[float], seed: int, notes: list[str]) -> CtaModel:
        """Return the fitted model without empty clusters; ``z`` is up to date with the view."""
        used, labels = np.unique(self.labels, return_inverse=True)
        if len(used) < self.problem.n_clusters:
            left_out = self.problem.n_clusters - len(used)
            notes.append(f"{left_out} clusters left out: too few distinct vertices")
        factors = [self.factors[index] for index in used]
        width = self.problem.ranks
        light, dual = padded(factors, self.z.shape[1], width)
        weights = np.zeros((len(self.z), width.vert), dtype=np.float32)
        ranks = np.zeros((len(used), 3), dtype=np.int32)
        members = members_by_cluster(labels.astype(np.int32), len(used))
        for index, (own, verts) in enumerate(zip(factors, members, strict=True)):
            ranks[index] = width.view, own.light.shape[1], len(own.dual)
            weights[verts, : len(own.dual)] = projected_weights(self.z[verts], own)
        return CtaModel(
            view_basis=self.view_basis,
            light_bases=light,
            dual_bases=dual,
            weights=weights,
            labels=labels.astype(np.int32),
            ranks=ranks,
            objective=objective,
            initial_energy=self.squared_norm,
            squared_error_per_vertex=self.view_errors + self.errors,
            iterations=len(objective),
            seed=seed,
            n_channels=self.problem.n_channels,
            notes=notes,
        )
