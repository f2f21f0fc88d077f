"""The Pareto frontier of what accuracy costs: points that no other beats in error and cost."""

from collections.abc import Sequence

import numpy as np


def pareto_frontier(costs: Sequence[int | float], errors: Sequence[int | float]) -> list[int]:
    """Find the points for which no other has as small a cost and as small an error.

    A point is beaten by one that is at most as large in both and smaller in one; points that are
    equal in both do not beat each other, and stand on the frontier together.

    Parameters
    ----------
    costs, errors
        Finite numbers, one of each a point.

    Returns
    -------
    list of int
        Places of the points on the frontier, by rising cost, so that the error falls (equal points
        in the order given).

    Raises
    ------
    ValueError
        Where lengths differ, or a number is not finite; names its place.
    """
    if len(costs) != len(errors):
        raise ValueError(f"there are {len(costs)} costs and {len(errors)} errors")
    for name, values in (("cost", costs), ("error", errors)):
        for place, value in enumerate(values):
            if not np.isfinite(value):
                raise ValueError(f"the {name} of point {place} is {value}, which has no place")
    frontier: list[int] = []
    order = sorted(range(len(costs)), key=lambda place: (costs[place], errors[place]))
    for place in order:
        if frontier:
            last = frontier[-1]
            equal = costs[place] == costs[last] and errors[place] == errors[last]
            if errors[place] >= errors[last] and not equal:
                continue
        frontier.append(place)
    return frontier
