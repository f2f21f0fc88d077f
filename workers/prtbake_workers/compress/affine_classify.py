"""Classification of vertices by approximation error ([Sloan2003]_ section 4.2).

With o any point and x' = x - o, the squared error of vertex x in a cluster of components B is

    |x'|^2 - 2 x'.m + |m|^2 - |B x'|^2,

m the point of the cluster's subspace nearest to o, seen from there: m is orthogonal to B, so no
term mixes the two.  The products x'.m and B x' of all vertices with all clusters of as many
components are one matrix product.

Where the signal has many more dimensions than a cluster has components, most of that product need
not be done.  What a vertex's own cluster makes of it, y, is given by few numbers, so its distances
from all subspaces are products of small matrices, shared by the cluster's vertices; x lies no
nearer to any of them than that distance less |x - y|.  Only clusters that could be nearer than the
present one are tried, which leaves out none that is.

Either way proposes only; `AffineClusters.move` decides by the residual itself, so neither rounding
nor cancellation near zero error moves a vertex.

With coherence, what is proposed is the cluster of least E of [Chen2005]_ (9) among those that
approximate the vertex better than its own, and only where E falls too.
"""

from collections.abc import Sequence

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I32, I64, Bool, Float32, Float64, Int32, Int64
from prtbake_workers.compress.affine_clusters import AffineClusters, AffineSubspace
from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.coherence import CoherentMoves
from prtbake_workers.compress.energy import row_energy
from prtbake_workers.compress.parallel import map_in_order

# Products held at a time: large beside a BLAS block, small beside the cache they are summed in.
BLOCK_BYTES = 4 << 20
# Dimensions over a cluster's mean and components from which bounding first is the faster way, and
# clusters among which it is worth it.
LEAST_DIMENSIONS_OVER = 16
LEAST_CLUSTERS = 16
# Relative rounding of the float32 bound, two products and sums of squares: 1e-6 at the worst.
BOUND_SLACK = 1e-5


def reclassify(clusters: AffineClusters, fees: Float64[F64, " verts"] | None = None) -> int:
    """Move every vertex to the cluster that serves it best; return how many moved.

    Parameters
    ----------
    clusters
        Changed: labels and errors.  The squared error, with the fees, does not rise.
    fees
        As in `propose_clusters`.
    """
    moves = clusters.coherent_moves(fees)
    proposed = propose_clusters(
        clusters.signal, clusters.subspaces, clusters.labels, clusters.errors, fees, moves
    )
    return clusters.move(proposed, fees, moves)


def propose_clusters(
    signal: Float32[F32, "verts dims"],
    subspaces: Sequence[AffineSubspace],
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
    fees: Float64[F64, " verts"] | None = None,
    moves: CoherentMoves | None = None,
) -> Int32[I32, " verts"]:
    """Return the cluster that approximates each vertex best, to float32.

    Parameters
    ----------
    signal, subspaces
        Rows of the vertices, and mean and components of every cluster.
    labels, errors
        The present cluster of each vertex, which stays where no other is better, and the vertex's
        squared residual there.
    fees
        What a component of its cluster costs each vertex, as squared error; none when None.
    moves
        With it, a vertex goes where it costs least, of the clusters that approximate it better.
    """
    fees = np.zeros(len(signal)) if fees is None else fees
    candidates = _Candidates(subspaces)
    columns = 1.0 + candidates.ranks.mean()
    wide = signal.shape[1] > LEAST_DIMENSIONS_OVER * columns
    if moves is not None or (wide and len(subspaces) >= LEAST_CLUSTERS):
        return _among_possible(signal, candidates, labels, errors, fees, moves)
    return _among_all(signal, candidates, labels, fees)


class _Candidates:
    """Subspaces seen from a point amid their means, in groups of equal rank."""

    def __init__(self, subspaces: Sequence[AffineSubspace]) -> None:
        means = np.array([subspace.mean for subspace in subspaces])
        self.origin = means.mean(axis=0, dtype=np.float64).astype(np.float32)
        self.means = means - self.origin
        self.bases = [subspace.basis for subspace in subspaces]
        self.ranks = np.array([len(basis) for basis in self.bases])
        # m, and |m|^2
        self.nearest = np.array(
            [
                mean - (basis.astype(np.float64) @ mean) @ basis
                for mean, basis in zip(self.means.astype(np.float64), self.bases, strict=True)
            ]
        )
        self.constants = np.einsum("cd,cd->c", self.nearest, self.nearest).astype(np.float32)
        self.groups = [np.flatnonzero(self.ranks == rank) for rank in np.unique(self.ranks)]
        self.stacks = [self._stack(group) for group in self.groups]

    def _stack(self, group: Int64[I64, " group"]) -> Float32[F32, "columns dims"]:
        """Return m of a group of clusters, then all their first components and so on."""
        bases = np.array([self.bases[cluster] for cluster in group])
        rows = [self.nearest[group].astype(np.float32), *bases.transpose(1, 0, 2)]
        return np.concatenate(rows)

    def relative_errors(self, rows: Float32[F32, "points dims"]) -> Float32[F32, "points clusters"]:
        """Return the squared errors of points about the origin in all clusters, less |x'|^2."""
        return self.sums([rows @ stack.T for stack in self.stacks])

    def sums(self, products: Sequence[F32]) -> Float32[F32, "points clusters"]:
        """Return the same from the products with each stack, which are used up."""
        errors = np.empty((len(products[0]), len(self.ranks)), dtype=np.float32)
        for group, product in zip(self.groups, products, strict=True):
            own = self.constants[group] - 2.0 * product[:, : len(group)]
            for first in range(len(group), product.shape[1], len(group)):
                along = product[:, first : first + len(group)]
                np.multiply(along, along, out=along)
                own -= along
            errors[:, group] = own
        return errors


def _among_all(
    signal: Float32[F32, "verts dims"],
    candidates: _Candidates,
    labels: Int32[I32, " verts"],
    fees: Float64[F64, " verts"],
) -> Int32[I32, " verts"]:
    n_columns = int(np.sum(candidates.ranks + 1))
    step = max(16, BLOCK_BYTES // (4 * n_columns))
    proposed = labels.copy()

    def propose(start: int) -> None:
        block = slice(start, start + step)
        errors = candidates.relative_errors(signal[block] - candidates.origin)
        errors += (fees[block, None] * candidates.ranks).astype(np.float32)
        best = np.argmin(errors, axis=1).astype(np.int32)
        at = np.arange(len(errors))
        better = errors[at, best] < errors[at, labels[block]]
        proposed[block][better] = best[better]

    map_in_order(propose, range(0, len(signal), step))
    return proposed


def _among_possible(
    signal: Float32[F32, "verts dims"],
    candidates: _Candidates,
    labels: Int32[I32, " verts"],
    errors: Float64[F64, " verts"],
    fees: Float64[F64, " verts"],
    moves: CoherentMoves | None,
) -> Int32[I32, " verts"]:
    members = members_by_cluster(labels, len(candidates.ranks))
    proposed = labels.copy()

    def propose(cluster: int) -> None:
        verts = members[cluster]
        if len(verts) == 0:
            return
        rows = signal[verts] - candidates.origin
        energy = np.zeros(len(rows)) if moves is None else row_energy(rows)
        possible = _possible(rows, cluster, candidates, errors[verts], fees[verts])
        best = np.full(len(verts), cluster, dtype=np.int32)
        own = _error_in(rows, cluster, candidates) + fees[verts] * candidates.ranks[cluster]
        least = own.copy() if moves is None else moves.own[verts]
        for other in np.flatnonzero(possible.any(axis=0)).tolist():
            some = np.flatnonzero(possible[:, other])
            charge = fees[verts[some]] * candidates.ranks[other]
            found = _error_in(rows[some], other, candidates) + charge
            if moves is not None:
                nearer = found < own[some]
                some = some[nearer]
                found = moves.cost(verts[some], other, found[nearer] + energy[some])
            better = found < least[some]
            best[some[better]] = other
            least[some[better]] = found[better]
        proposed[verts] = best

    map_in_order(propose, range(len(candidates.ranks)))
    return proposed


def _possible(
    rows: Float32[F32, "verts dims"],
    cluster: int,
    candidates: _Candidates,
    errors: Float64[F64, " verts"],
    fees: Float64[F64, " verts"],
) -> Bool[B8, "verts clusters"]:
    """Return which clusters could approximate members of one better than that one does."""
    mean, basis = candidates.means[cluster], candidates.bases[cluster]
    frame = np.concatenate([mean[None], basis])
    ones = np.ones((len(rows), 1), dtype=np.float32)
    places = np.concatenate([ones, (rows - mean) @ basis.T], axis=1)
    products = [places @ (frame @ stack.T) for stack in candidates.stacks]
    size = row_energy(places @ frame)[:, None]
    # squared distances of y from all subspaces, at least
    away = candidates.sums(products) + size
    away -= BOUND_SLACK * (size + candidates.constants)
    # what a cluster may leave of x for a move to pay
    allowed = errors[:, None] + fees[:, None] * (candidates.ranks[cluster] - candidates.ranks)
    reach = np.sqrt(np.maximum(allowed, 0.0)) + np.sqrt(errors)[:, None]
    possible = (allowed > 0.0) & (away < reach**2)
    possible[:, cluster] = False
    return np.asarray(possible, dtype=np.bool_)


def _error_in(
    rows: Float32[F32, "verts dims"], cluster: int, candidates: _Candidates
) -> Float64[F64, " verts"]:
    """Return the squared errors of vertices in one cluster, less |x'|^2."""
    along = rows @ candidates.bases[cluster].T
    nearest = candidates.nearest[cluster].astype(np.float32)
    errors = candidates.constants[cluster] - 2.0 * (rows @ nearest)
    errors -= np.einsum("vp,vp->v", along, along)
    return np.asarray(errors, dtype=np.float64)
