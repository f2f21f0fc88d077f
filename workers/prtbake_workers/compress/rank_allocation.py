"""How many components each cluster gets of a storage that all share."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64


class Allocation(NamedTuple):
    """Components of each cluster.

    Attributes
    ----------
    ranks
        How many.
    price
        What the last of them takes off the squared error for a unit of storage: none that was left
        out for want of storage alone takes more.  0 where nothing was left out.
    """

    ranks: Int64[I64, " clusters"]
    price: float


def allocate_ranks(
    gains: Sequence[F64], costs: Float64[F64, " clusters"], budget: float
) -> Allocation:
    """Take components in the order of their gain for what they cost, while there is storage.

    Parameters
    ----------
    gains
        D_i^2 of the components of each cluster, falling: what each takes off the squared error.
    costs
        What one component of each cluster costs, > 0.  [Sloan2003]_ section 4.3 ranks by D_i^2 /
        m_k, the m_k weights that a component brings to the m_k vertices of its cluster; with the
        component's own n numbers it costs m_k + n.
    budget
        Storage for all, in the unit of the costs.

    Notes
    -----
    Where a component no longer fits, later ones of clusters that cost less may.
    """
    n_clusters = len(gains)
    counts = [len(own) for own in gains]
    cluster = np.repeat(np.arange(n_clusters), counts)
    gain = np.concatenate([np.zeros(0), *gains])
    rate = gain / costs[cluster]
    ranks = np.zeros(n_clusters, dtype=np.int64)
    full = np.zeros(n_clusters, dtype=np.bool_)
    price, left_out = 0.0, False
    # stable: of equals in one cluster the stronger one comes first
    for index in np.argsort(-rate, kind="stable").tolist():
        own = cluster[index]
        if rate[index] <= 0.0:
            break
        if full[own]:
            continue
        if costs[own] > budget:
            full[own] = left_out = True
            continue
        budget -= costs[own]
        ranks[own] += 1
        price = float(rate[index])
    return Allocation(ranks, price if left_out else 0.0)
