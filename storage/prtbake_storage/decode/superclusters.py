"""Index buffers for renderers that hold the data of a few clusters at a time.

Such a renderer draws a part one supercluster after the other: it loads what the clusters of one
need into its constant registers and draws that one's index buffer, with vertices of other
superclusters black, and adds what it draws up ([Sloan2003]_ section 6.2).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

I32 = NDArray[np.int32]


@dataclass(frozen=True, kw_only=True)
class Superclusters:
    """Clusters of a part in groups whose data fit a renderer's registers.

    Attributes
    ----------
    registers
        Registers of four numbers that every group fits into.
    of_cluster
        (clusters,) supercluster of each cluster, from 0 on, none left out.
    indices
        (draws, 3) corners of the triangles to draw, in the mesh's numbering of vertices, one
        supercluster after the other.  A triangle is there once for each that it has a corner in.
    starts
        (superclusters + 1,) rows of ``indices`` where each begins, and their number.
    """

    registers: int
    of_cluster: I32
    indices: I32
    starts: I32

    @property
    def n_superclusters(self) -> int:
        """Groups, each of which is drawn at once."""
        return len(self.starts) - 1

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return int(self.of_cluster.nbytes + self.indices.nbytes + self.starts.nbytes)


class Draws(NamedTuple):
    """Triangles to draw, supercluster by supercluster, and where each of these begins."""

    triangles: I32
    starts: I32


def draws(faces: I32, groups: I32) -> Draws:
    """List the triangles with a corner in each group, in the order of ``faces``.

    Parameters
    ----------
    faces
        (tris, 3) corners, indices into ``groups``.
    groups
        (verts,) supercluster of each vertex, from 0 on.
    """
    n_tris = len(faces)
    keys = groups[faces].astype(np.int64) * n_tris + np.arange(n_tris)[:, None]
    drawn = np.unique(keys)
    bounds = np.arange(int(groups.max(initial=-1)) + 2, dtype=np.int64) * n_tris
    triangles = (drawn % max(1, n_tris)).astype(np.int32)
    return Draws(triangles, np.searchsorted(drawn, bounds).astype(np.int32))


def check_superclusters(
    where: str, groups: Superclusters, faces: I32, labels: I32, n_clusters: int, first: int
) -> None:
    """Hold the index buffers of a part against its triangles and labels.

    Parameters
    ----------
    where
        Name of the group of the file, for the message.
    groups
        What is held.
    faces
        (tris, 3) triangles of the part, in its own numbering of vertices.
    labels
        (verts,) cluster of each vertex of the part.
    n_clusters, first
        Clusters of the part, and its first vertex in the mesh's numbering.

    Raises
    ------
    ValueError
        Naming the first array that does not say what the labels say.
    """
    own = groups.of_cluster
    if own.shape != (n_clusters,):
        raise ValueError(f"{where}/of_cluster has shape {own.shape}, not ({n_clusters},)")
    if not np.array_equal(np.unique(own), np.arange(groups.n_superclusters)):
        raise ValueError(f"{where}/of_cluster does not use 0 to {groups.n_superclusters - 1}")
    if groups.registers < 1:
        raise ValueError(f"{where}: registers is {groups.registers}, not at least 1")
    expected = draws(faces, own[labels])
    if not np.array_equal(groups.starts, _padded(expected.starts, groups.n_superclusters)):
        raise ValueError(f"{where}/starts are not those of the triangles of each supercluster")
    if not np.array_equal(groups.indices, faces[expected.triangles] + np.int32(first)):
        raise ValueError(f"{where}/indices are not the triangles of each supercluster")


def _padded(starts: I32, n_superclusters: int) -> I32:
    """Let superclusters that no vertex is in draw nothing."""
    return np.pad(starts, (0, max(0, n_superclusters + 1 - len(starts))), mode="edge")
