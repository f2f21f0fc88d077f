"""What rows of scattering cost: work to build and to multiply, bytes to hold."""

from collections.abc import Mapping
from itertools import pairwise

from prtbake_workers.planning.cluster_limit import ClusterLimit
from prtbake_workers.planning.cost import CHILD_BYTES
from prtbake_workers.transport.part_scattering import COLUMNS_PER_PASS
from prtbake_workers.transport.subsurface import VERTICES_PER_CHUNK

ROWS_PER_TASK = 1 << 15
"""A few seconds of work, 100 to 300 MB of rows; of a part that takes `MOST_RUNS` more."""

MOST_RUNS = 8
"""Of a part: each sorts all of its triangles anew, 5 to 8 microseconds a vertex."""

NODES_PER_VERTEX = 3
"""Clusters and triangles of the tree."""

TREE_BYTES = 1200
"""Of a vertex: its nodes, and the matrix that takes transfer to their means."""

WORKSPACE_BYTES = 128
"""Of an entry that is being built."""


def row_runs(n_verts: int) -> list[tuple[int, int]]:
    """Cut the rows of a part into runs of much the same length, a task each."""
    n_runs = min(-(-n_verts // ROWS_PER_TASK), MOST_RUNS)
    return list(pairwise(round(i * n_verts / max(1, n_runs)) for i in range(n_runs + 1)))


def rows_work(n_verts: Mapping[int, int], limits: Mapping[int, ClusterLimit]) -> dict[str, float]:
    """Count what building the rows of all parts that scatter does; every run sorts its part."""
    runs = {part: len(row_runs(n_verts[part])) for part in limits}
    return {
        "tasks": float(sum(runs.values())),
        "vertices": float(sum(runs[part] * n_verts[part] for part in limits)),
        "entries": sum((n_verts[part] * own.entries for part, own in limits.items()), start=0.0),
    }


def product_work(
    n_verts: Mapping[int, int],
    limits: Mapping[int, ClusterLimit],
    *,
    times: int,
    n_channels: int,
    n_coeffs: int,
) -> dict[str, float]:
    """Count the multiplications of scattering all coefficients so many times."""
    entries = sum(n_verts[part] * limit.entries for part, limit in limits.items())
    return {"sparse_flops": times * 2.0 * entries * n_channels * n_coeffs}


def rows_memory_bytes(
    n_verts: Mapping[int, int], limits: Mapping[int, ClusterLimit], channels: Mapping[int, int]
) -> int:
    """Predict the peak memory of building a run of rows: they are joined from their chunks."""
    largest = max(
        WORKSPACE_BYTES * limit.entries * VERTICES_PER_CHUNK
        + TREE_BYTES * n_verts[part]
        + 2
        * _row_bytes(limit, channels[part])
        * max(stop - start for start, stop in row_runs(n_verts[part]))
        for part, limit in limits.items()
    )
    return CHILD_BYTES + round(largest)


def scattering_memory_bytes(
    n_verts: Mapping[int, int],
    limits: Mapping[int, ClusterLimit],
    channels: Mapping[int, int],
    *,
    n_columns: int,
) -> int:
    """Predict what a block of so many coefficients holds of rows, trees and means over clusters.

    Rows that are mapped in from a file count too: the system keeps them as long as it has room.
    """
    columns = min(n_columns, COLUMNS_PER_PASS)
    held = sum(
        n_verts[part] * (_row_bytes(limit, channels[part]) + TREE_BYTES)
        for part, limit in limits.items()
    )
    # means in float32, and half of them at a time in float64
    means = 4 * columns * (1 + 2 * NODES_PER_VERTEX) * max((n_verts[p] for p in limits), default=0)
    return held + means


def _row_bytes(limit: ClusterLimit, n_channels: int) -> int:
    return round(4 * (1 + n_channels) * limit.entries)
