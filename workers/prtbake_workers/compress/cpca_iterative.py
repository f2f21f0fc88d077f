"""Iterative clustered PCA: vertices go to the cluster that approximates them best.

[Sloan2003]_ section 4.2, after [Kambhatla1997]_: components join one by one, from none to those
asked for, with iterations of classification and PCA between them, which avoids the poor minima
that all at once would end in.
"""

import numpy as np

from prtbake_workers.compress.affine_classify import reclassify
from prtbake_workers.compress.affine_clusters import AffineClusters
from prtbake_workers.compress.monotone import ObjectiveTrace
from prtbake_workers.compress.progress import Progress

# Share of the objective that an iteration must win to be followed by another.  On the way a number
# of components is only the start of the next; the last decides.
CONVERGED_ON_THE_WAY = 3e-3
CONVERGED = 1e-3


def iterate(
    clusters: AffineClusters,
    n_components: int,
    trace: ObjectiveTrace,
    max_iterations: int,
    progress: Progress,
) -> AffineClusters:
    """Return the clusters after components joined one by one, or all at once where that is better.

    Parameters
    ----------
    clusters
        Vertex clusters of least distance to their means, as the static method has them, with
        ``n_components`` found in each; changed by the iteration.
    n_components
        Components of every cluster in the end, at least 1.
    trace
        Takes the objective after every model step.
    max_iterations
        Most classifications for each number of components.
    progress
        Called after each model step.

    Notes
    -----
    Neither minimum is always the lower one.  Where the first ends above the static method, whose
    clusters it began with, the same iterations start from the static method itself, so that the
    result is never above it.
    """
    static = clusters.copy()
    _use_all_alike(static, n_components)
    before = list(trace.values)
    for rank in range(1, n_components + 1):
        last = rank == n_components
        settle(clusters, rank, trace, max_iterations, CONVERGED if last else CONVERGED_ON_THE_WAY)
        progress(rank / n_components, f"{rank} components, error {trace.ratio:.3%}")
    if clusters.squared_error <= static.squared_error:
        return clusters
    trace.values[:] = before
    settle(static, n_components, trace, max_iterations, CONVERGED)
    return static


def settle(
    clusters: AffineClusters,
    rank: int,
    trace: ObjectiveTrace,
    max_iterations: int,
    tolerance: float,
) -> None:
    """Alternate between PCA and classification at one number of components."""
    _use_all_alike(clusters, rank)
    trace.append(clusters.squared_error)
    for _ in range(max_iterations):
        if trace.values[-1] <= 0.0 or not trace.has_time():
            break
        if reclassify(clusters) == 0:
            break
        clusters.fill_empty_clusters()
        clusters.find_components()
        _use_all_alike(clusters, rank)
        trace.append(clusters.squared_error)
        if trace.has_converged(tolerance):
            break


def _use_all_alike(clusters: AffineClusters, rank: int) -> None:
    clusters.use(np.full(clusters.n_clusters, rank))
