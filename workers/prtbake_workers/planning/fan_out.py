"""How many tasks share each step of a tensor approximation.

By counts of work alone, as tiles of a bake are cut: who makes the steps changes no byte of the
asset, but the number of tasks should not depend on the machine that plans.
"""

TASK_FLOPS = 3.2e11
"""Of a task: 8 s at the round 40 Gflop/s that tiles are cut by.  It stands against about a second
of starting a process and reading the state, in some 20 rounds."""

MOST_TASKS = 64
"""Of one step; as many as a job keeps in the queue at once."""

TRIED_SHARE, SWEEPS = 0.14, 2
"""Pairs of vertex and cluster that a classification tries, and sweeps of a model step."""


def tasks_a_step(
    *, n_verts: int, n_rows: int, n_coeffs: int, n_clusters: int, light: int, vert: int
) -> int:
    """Return the tasks that a step's clusters are cut among: 1 keeps the whole fit in one task.

    Half of an iteration is a step: classifying the vertices, or fitting the clusters' bases.

    Parameters
    ----------
    n_rows
        View rows of a vertex, those of all channels.
    n_verts, n_coeffs, n_clusters, light, vert
        The tensor's other sizes, and its ranks.
    """
    dims = float(n_rows * n_coeffs)
    classify = TRIED_SHARE * n_verts * dims * n_clusters * vert + (n_clusters * vert) ** 2 * dims
    model = SWEEPS * n_verts * dims * (vert + 2 * light)
    tasks = int(2.0 * (classify + model) / (2.0 * TASK_FLOPS))
    return max(1, min(tasks, n_clusters, MOST_TASKS))
