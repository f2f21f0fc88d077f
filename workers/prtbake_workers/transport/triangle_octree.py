"""An octree over triangles: clusters that stand for their members from far away."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import csr_array, diags_array

from prtbake_workers.arrays import F64, I32, I64, Float64, Int32, Int64
from prtbake_workers.geometry.mesh import face_area_vectors

MAX_LEVEL = 20
"""Halvings of the bounding cube: a million cells along each edge, 60 bits for three axes."""

MOST_SINGLES = 8
"""A cluster of no more triangles is split into them at once."""


@dataclass(frozen=True, eq=False)
class TriangleOctree:
    """Clusters of triangles; node 0 is the root, children come after their parent.

    Attributes
    ----------
    centres
        Area-weighted mean of the members' centroids.
    radii
        No member reaches further from the centre.
    areas
        Sum of the members' areas, positive.
    spreads
        Covariance of the points of all members.
    first_child, n_children
        Children are consecutive; a single triangle has none.
    triangles
        Number of the triangle where the node is one, else -1.
    means
        float64 (nodes, verts): takes vertex values to their area-weighted mean over each node, the
        values being linear over triangles.
    """

    centres: Float64[F64, "nodes 3"]
    radii: Float64[F64, " nodes"]
    areas: Float64[F64, " nodes"]
    spreads: Float64[F64, "nodes 3 3"]
    first_child: Int32[I32, " nodes"]
    n_children: Int32[I32, " nodes"]
    triangles: Int32[I32, " nodes"]
    means: Any

    @property
    def n_nodes(self) -> int:
        """Clusters and single triangles; 0 where nothing has an area."""
        return len(self.areas)


def build_triangle_octree(
    positions: Float64[F64, "verts 3"], faces: Int32[I32, "tris 3"]
) -> TriangleOctree:
    """Sort triangles into an octree by their centroids; those without area are left out.

    Cells with all members in one child are passed over, so that parts far apart, or many triangles
    at one place, make no chains.  Time and memory grow as n times the depth.
    """
    areas = np.linalg.norm(face_area_vectors(positions, faces), axis=1)
    kept = np.flatnonzero(areas > 0.0)
    centroids = positions[faces[kept]].mean(axis=1)
    codes = _morton_codes(centroids)
    order = np.argsort(codes, kind="stable")
    kept, centroids = kept[order], centroids[order]
    start, stop, first_child, n_children = _split(codes[order])

    sizes = stop - start
    member = np.arange(int(sizes.sum())) + np.repeat(start - (np.cumsum(sizes) - sizes), sizes)
    indptr = np.concatenate([[0], np.cumsum(sizes)])
    shape = (len(start), len(kept))
    members = csr_array((areas[kept][member], member, indptr), shape=shape)
    total = members.sum(axis=1)
    centres = (members @ centroids) / total[:, None]
    corners = positions[faces[kept]] - centroids[:, None]
    reach = np.linalg.norm(corners, axis=2).max(axis=1)
    apart = centroids[member] - np.repeat(centres, sizes, axis=0)
    own = np.einsum("tci,tcj->tij", corners, corners) / 12.0
    spreads, radii = np.empty((len(start), 3, 3)), np.empty(len(start))
    if len(start):
        radii = np.maximum.reduceat(np.linalg.norm(apart, axis=1) + reach[member], indptr[:-1])
        for i, j in np.ndindex(3, 3):
            moment = members.data * (apart[:, i] * apart[:, j] + own[member, i, j])
            spreads[:, i, j] = np.add.reduceat(moment, indptr[:-1]) / total
    thirds = csr_array(
        (np.full(3 * len(kept), 1.0 / 3.0), faces[kept].ravel(), 3 * np.arange(len(kept) + 1)),
        shape=(len(kept), len(positions)),
    )
    return TriangleOctree(
        centres=centres,
        radii=radii,
        areas=total,
        spreads=spreads,
        first_child=first_child,
        n_children=n_children,
        triangles=np.where(sizes == 1, kept[start], -1).astype(np.int32),
        means=(diags_array(1.0 / total) @ members @ thirds).tocsr(),
    )


def _morton_codes(points: Float64[F64, "points 3"]) -> Int64[I64, " points"]:
    """Interleave the bits of the cell numbers, x first."""
    if not len(points):
        return np.empty(0, np.int64)
    low = points.min(axis=0)
    side = float((points.max(axis=0) - low).max()) or 1.0
    cells = ((points - low) / side * (1 << MAX_LEVEL)).astype(np.int64)
    cells = np.minimum(cells, (1 << MAX_LEVEL) - 1)
    codes = np.zeros(len(points), np.int64)
    for bit in range(MAX_LEVEL):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + 2 - axis)
    return codes


def _split(codes: Int64[I64, " tris"]) -> tuple[I64, I64, I32, I32]:
    """Split ranges of sorted codes, a level at a time: start, stop, first child, children."""
    if not len(codes):
        none = np.empty(0, np.int64)
        return none, none, none.astype(np.int32), none.astype(np.int32)
    starts, stops = [np.array([0])], [np.array([len(codes)])]
    parents = [np.array([-1])]
    n_nodes = 1
    nodes = np.flatnonzero(stops[0] > 1)
    low, high = starts[0][nodes], stops[0][nodes]
    for level in range(1, MAX_LEVEL + 2):
        if not len(nodes):
            break
        sizes = high - low
        member = np.arange(int(sizes.sum())) + np.repeat(low - (np.cumsum(sizes) - sizes), sizes)
        owner = np.repeat(np.arange(len(nodes)), sizes)
        cut = np.concatenate([[True], owner[1:] != owner[:-1]])
        if level <= MAX_LEVEL:
            cell = codes[member] >> (3 * (MAX_LEVEL - level))
            cut[1:] |= cell[1:] != cell[:-1]
            cut |= (sizes <= MOST_SINGLES)[owner]
        else:
            cut[:] = True
        at = np.flatnonzero(cut)
        child_low = member[at]
        child_high = child_low + np.diff(np.append(at, len(member)))
        child_owner = owner[at]
        alone = np.bincount(child_owner, minlength=len(nodes)) == 1
        made = ~alone[child_owner]
        starts.append(child_low[made])
        stops.append(child_high[made])
        parents.append(nodes[child_owner[made]])
        number = n_nodes + np.arange(int(made.sum()))
        n_nodes += len(number)
        more = child_high[made] - child_low[made] > 1
        nodes = np.concatenate([nodes[alone], number[more]])
        low = np.concatenate([low[alone], child_low[made][more]])
        high = np.concatenate([high[alone], child_high[made][more]])
        by_place = np.argsort(low, kind="stable")
        nodes, low, high = nodes[by_place], low[by_place], high[by_place]
    parent = np.concatenate(parents)
    n_children = np.bincount(parent[1:], minlength=n_nodes).astype(np.int32)
    first_child = np.full(n_nodes, -1, np.int32)
    # a parent's children are made at once, in order: the last write is the first of them
    first_child[parent[:0:-1]] = np.arange(n_nodes - 1, 0, -1, dtype=np.int32)
    return np.concatenate(starts), np.concatenate(stops), first_child, n_children
