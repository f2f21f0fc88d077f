"""Numbering equal rows: how vertices are found to be one."""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64


def group_rows(
    rows: Float64[F64, "verts axes"],
) -> tuple[Int64[I64, " verts"], Int64[I64, " rows"]]:
    """Give equal rows one number, in the order of their first appearance.

    Returns
    -------
    group, first
        Group of each row, and the first row of each group.
    """
    # -0.0 and 0.0 are one position
    order = np.lexsort((rows + 0.0).T[::-1])
    ordered = rows[order]
    new = np.ones(len(rows), np.bool_)
    new[1:] = np.any(ordered[1:] != ordered[:-1], axis=1)
    sorted_group = np.cumsum(new) - 1
    # lexsort is stable, so the first of each run is the first in the file
    first = order[new]
    rank = np.empty(len(first), np.int64)
    by_file = np.argsort(first, kind="stable")
    rank[by_file] = np.arange(len(first))
    group = np.empty(len(rows), np.int64)
    group[order] = rank[sorted_group]
    return group, first[by_file].astype(np.int64)
