"""Adaptive clustered PCA: as many components a cluster as pay there, at the same storage in all.

[Sloan2003]_ section 4.3.  The paper's step, a classification by error and then a new distribution,
can raise the error: clusters of many components attract vertices, which leaves less storage for
components.  Such a step is taken back.  From there on a vertex is charged for the weights that it
would need, at the price that the last component taken sets: error plus price times storage then
falls in both halves of a step.
"""

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.compress.affine_classify import reclassify
from prtbake_workers.compress.affine_clusters import AffineClusters
from prtbake_workers.compress.cpca_iterative import CONVERGED
from prtbake_workers.compress.monotone import ObjectiveTrace
from prtbake_workers.compress.progress import Progress
from prtbake_workers.compress.rank_allocation import allocate_ranks

# Components that a cluster may have, over the number that each had before.  Decoders hold a weight
# a vertex for each of the largest cluster's components; on real transfer 1.5 to 2 times are taken.
MOST_OVER_BEFORE = 4


def adapt(
    clusters: AffineClusters,
    trace: ObjectiveTrace,
    max_iterations: int,
    progress: Progress,
) -> AffineClusters:
    """Return the clusters with components distributed by what they win.

    Parameters
    ----------
    clusters
        As many components in each, as the iterative method leaves them.
    trace
        Takes the objective after every step that is kept.
    max_iterations
        Most classifications, without a charge and then with it.
    progress
        Called after each step.

    Returns
    -------
    AffineClusters
        At most as many numbers stored, means, components and weights together, as ``clusters``
        had, and no more error.
    """
    budget = stored_numbers(clusters)
    n_dims = clusters.signal.shape[1]
    redistributed = clusters.copy()
    redistributed.deepen(min(MOST_OVER_BEFORE * clusters.depth, n_dims))
    best, price = clusters, _distribute(redistributed, budget)
    if redistributed.squared_error > clusters.squared_error:
        return clusters
    best = redistributed
    trace.append(best.squared_error)
    n_steps = 2 * max_iterations
    for charged in (False, True):
        for iteration in range(max_iterations):
            if not trace.has_time():
                return best
            trial = best.copy()
            fees = charged * price / _served(trial.weights)
            if reclassify(trial, fees) == 0:
                break
            trial.fill_empty_clusters()
            trial.find_components()
            new_price = _distribute(trial, budget)
            if trial.squared_error > best.squared_error:
                break
            best, price = trial, new_price
            trace.append(best.squared_error)
            done = (charged * max_iterations + iteration + 1) / n_steps
            progress(done, f"adapting, error {trace.ratio:.3%}")
            if trace.has_converged(CONVERGED):
                break
    return best


def stored_numbers(clusters: AffineClusters) -> float:
    """Return how many numbers the components and the vertices' weights are, means not counted."""
    used = np.array([len(subspace.basis) for subspace in clusters.subspaces])
    return float(used @ (clusters.sizes + clusters.signal.shape[1]))


def _distribute(clusters: AffineClusters, budget: float) -> float:
    """Use the components that win most for their storage; return the price of the last."""
    costs = (clusters.sizes + clusters.signal.shape[1]).astype(np.float64)
    ranks, price = allocate_ranks(clusters.gains, costs, budget)
    clusters.use(ranks)
    return price


def _served(weights: Float64[F64, " verts"]) -> Float64[F64, " verts"]:
    """Return the weights, with the mean in place of zero: what does not pull is served like others.

    A vertex of no weight would not be worth any component.
    """
    return np.where(weights > 0.0, weights, weights.mean())
