"""Clusters drawn together, so that triangles across their borders are drawn once.

Which clusters go together is limited by what a renderer can hold at a time.  Two greedy rules are
tried, and the one that leaves the fewer draws is taken: pairs of groups merged in order of what
that saves ([Sloan2003]_ section 5), and groups grown one after the other from the largest cluster
left ([Chen2005]_ section 4.3).
"""

import numpy as np

from prtbake_storage.decode.overdraw import average_overdraw, triangle_overdraw
from prtbake_storage.decode.superclusters import Superclusters, draws
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import B8, I32, I64, Bool, Int32, Int64

NUMBERS_PER_REGISTER = 4


def registers_of_clusters(
    ranks: Int32[I32, "clusters 3"], *, with_mean: bool
) -> Int32[I32, " clusters"]:
    """Return the registers of four numbers that each lit cluster takes.

    A lit cluster is one vector of R_view numbers a colour for every weight of a vertex, and one for
    the mean.  Where R_view is 1 the three colours of a number share a register; else colours are
    drawn one after the other, four numbers to a register ([Sloan2003]_ section 6.2).

    Parameters
    ----------
    ranks
        True (view, light, vert) ranks of each cluster as an asset holds them.
    with_mean
        Whether a vertex is the mean of its cluster and something, as in clustered PCA.
    """
    view, vectors = ranks[:, 0], ranks[:, 2] + int(with_mean)
    packed = -(-(view * vectors) // NUMBERS_PER_REGISTER)
    return np.maximum(np.where(view == 1, vectors, packed), 1).astype(np.int32)


def make_superclusters(
    faces: Int32[I32, "tris 3"],
    labels: Int32[I32, " verts"],
    needs: Int32[I32, " clusters"],
    registers: int,
    *,
    first_vertex: int = 0,
) -> Superclusters:
    """Group the clusters of a part for ``registers``, with the index buffer of each group.

    Parameters
    ----------
    faces
        Corners of the part's triangles, indices into ``labels``.
    labels
        Cluster of each vertex.
    needs
        Registers that each cluster takes, at least 1.
    registers
        Registers there are, at least 1.
    first_vertex
        Of the part in the mesh, added to the index buffers.

    Raises
    ------
    SettingsError
        A cluster alone takes more than there are, with the cluster and both numbers.
    """
    check_registers(needs, registers)
    corners = labels[faces[triangle_overdraw(faces, labels) > 1]]
    sizes = np.bincount(labels, minlength=len(needs))
    found = [
        merge_pairs(corners, needs, registers),
        grow_groups(corners, needs, registers, sizes),
    ]
    groups = min(found, key=lambda one: (average_overdraw(faces, one[labels]), int(one.max())))
    drawn = draws(faces, groups[labels])
    return Superclusters(
        registers=registers,
        of_cluster=groups,
        indices=faces[drawn.triangles] + np.int32(first_vertex),
        starts=drawn.starts,
    )


def merge_pairs(
    corners: Int32[I32, "straddling 3"], needs: Int32[I32, " clusters"], registers: int
) -> Int32[I32, " clusters"]:
    """Merge the two groups that share most triangles and fit together, until none do.

    Parameters
    ----------
    corners
        Clusters of the corners of the triangles that straddle clusters.
    needs, registers
        As in `make_superclusters`.

    Returns
    -------
    of_cluster
        Group of each cluster, from 0 on.  Of equal pairs the one of lowest index goes first.

    References
    ----------
    [Sloan2003]_ section 5.
    """
    n_clusters = len(needs)
    every = np.arange(n_clusters, dtype=np.int32)
    owner, corners, taken = every.copy(), corners.copy(), needs.astype(np.int64)
    shared = np.stack([_shared(corners, every == one) for one in every])
    shared[taken[:, None] + taken > registers] = 0
    best = shared.max(axis=1)
    while best.any():
        kept = int(np.argmax(best))
        joined = int(np.argmax(shared[kept]))
        changed = (shared[kept] > 0) | (shared[joined] > 0)
        corners[corners == joined] = kept
        owner[owner == joined] = kept
        taken[kept] += taken[joined]
        row = _shared(corners, every == kept)
        row[taken + taken[kept] > registers] = 0
        shared[joined] = shared[:, joined] = 0
        shared[kept] = shared[:, kept] = row
        changed[[kept, joined]] = True
        best[changed] = shared[changed].max(axis=1)
    return _packed(owner, taken, registers)


def grow_groups(
    corners: Int32[I32, "straddling 3"],
    needs: Int32[I32, " clusters"],
    registers: int,
    sizes: Int64[I64, " clusters"],
) -> Int32[I32, " clusters"]:
    """Start a group from the largest cluster left and add what saves most while it fits.

    Parameters
    ----------
    corners, needs, registers
        As in `merge_pairs`.
    sizes
        Vertices of each cluster.

    References
    ----------
    [Chen2005]_ figure 4.6, but that a cluster which saves nothing is left for a group of its own,
    where it may save something.
    """
    n_clusters = len(needs)
    owner = np.full(n_clusters, -1, dtype=np.int32)
    taken = np.zeros(n_clusters, dtype=np.int64)
    while (owner < 0).any():
        seed = int(np.argmax(np.where(owner < 0, sizes, -1)))
        owner[seed] = seed
        taken[seed] = needs[seed]
        while True:
            saved = _shared(corners, owner == seed)
            saved[(owner >= 0) | (taken[seed] + needs > registers)] = 0
            if not saved.any():
                break
            one = int(np.argmax(saved))
            owner[one] = seed
            taken[seed] += needs[one]
    return _packed(owner, taken, registers)


def _shared(
    corners: Int32[I32, "straddling 3"], members: Bool[B8, " clusters"]
) -> Int64[I64, " clusters"]:
    """Return how many triangles each cluster outside shares with the members."""
    touching = corners[members[corners].any(axis=1)]
    a, b, c = touching.T
    counted = ~members[touching]
    counted[:, 1] &= b != a
    counted[:, 2] &= (c != a) & (c != b)
    return np.bincount(touching[counted], minlength=len(members)).astype(np.int64)


def _packed(
    owner: Int32[I32, " clusters"], taken: Int64[I64, " clusters"], registers: int
) -> Int32[I32, " clusters"]:
    """Give the groups numbers from 0 on, and those that fit together the same one.

    The largest is placed first, each with the first that leaves it room.
    """
    groups = np.unique(owner)
    of_group = np.zeros(len(owner), dtype=np.int32)
    free: list[int] = []
    for group in groups[np.argsort(-taken[groups], kind="stable")]:
        need = int(taken[group])
        place = next((i for i, room in enumerate(free) if room >= need), len(free))
        if place == len(free):
            free.append(registers)
        free[place] -= need
        of_group[group] = place
    return of_group[owner]


def check_registers(needs: Int32[I32, " clusters"], registers: int) -> None:
    """Refuse clusters that alone take more registers than there are.

    Raises
    ------
    SettingsError
        With the first such cluster and both numbers.
    """
    over = np.flatnonzero(needs > registers)
    if over.size:
        raise SettingsError(
            f"registers is {registers}: cluster {over[0]} takes {needs[over[0]]}; fewer components "
            "or lower ranks take fewer",
            pointer="/settings/compress/registers",
        )
