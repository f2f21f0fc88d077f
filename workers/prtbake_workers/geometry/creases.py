"""Creases: edges that stay sharp, and the vertices split along them."""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.topology import (
    Edges,
    around_edges,
    connected,
    corners_that_meet,
    find_edges,
)

ANGLE_SLACK_DEG = 1e-3
"""Angles are compared to this: the right angles of a box in float32 coordinates are off by less,
and must all fall on one side of a crease angle of 90 degrees."""


def smoothing_groups(
    positions: Float64[F64, "verts 3"],
    faces: Int64[I64, "tris 3"],
    place: Int64[I64, " verts"],
    crease_angle_deg: float,
) -> tuple[Int64[I64, "tris 3"], int]:
    """Say which corners share a normal.

    Parameters
    ----------
    positions, faces
        Triangles that all have an area, consistently wound.
    place
        Number of each vertex's position: a UV seam is no crease.
    crease_angle_deg
        Edges whose face normals differ by more than this are creases; 180 makes none.

    Returns
    -------
    groups, n_creases
        A number for each corner, the same where the normal is shared, and how many edges are
        creases.  Corners at different positions never share one.

    Notes
    -----
    A group is what can be reached about a position without crossing a crease.  A crease that ends
    at a position does not divide it.  Where no crease comes in, all corners of the position are
    one group, also those that no edge joins, as without a crease angle.  The normals at an edge
    are perpendicular to it, so where more than two faces meet they lie on a circle; each links
    with the next on it, and the edge is a crease if that leaves more than one group.
    """
    edges = find_edges(place[faces])
    area_vectors = face_area_vectors(positions, faces)
    normals = area_vectors / np.linalg.norm(area_vectors, axis=1, keepdims=True)
    halves, following = around_edges(edges, _azimuths(positions, faces, edges, normals))
    angles = _angles(normals[halves // 3], normals[following // 3])
    smooth = angles <= np.deg2rad(crease_angle_deg + ANGLE_SLACK_DEG)
    # a circle cut once is still in one piece
    n_cuts = np.bincount(edges.edge_of[halves[~smooth]], minlength=len(edges.n_faces_at))
    crease = n_cuts > 1
    left, right = corners_that_meet(edges, halves[smooth], following[smooth])
    group = connected(faces.size, left, right)
    at = place[faces]
    sharp = np.zeros(int(place.max()) + 1, np.bool_)
    on_crease = crease[edges.edge_of].reshape(-1, 3)
    sharp[at[on_crease]] = True
    sharp[np.roll(at, -1, axis=1)[on_crease]] = True
    group = np.where(sharp[at.ravel()], group, faces.size + at.ravel())
    return group.reshape(-1, 3), int(np.count_nonzero(crease))


def split_corners(
    faces: Int64[I64, "tris 3"], groups: Int64[I64, "tris 3"]
) -> tuple[Int64[I64, "tris 3"], Int64[I64, " split"], Int64[I64, " split"]]:
    """Give each vertex one copy a group of its corners.

    Returns
    -------
    faces, source, group
        The faces by the new vertices, and the old vertex and the group of each of these.  New
        vertices stand in the order of the old ones, which must all be used.
    """
    span = int(groups.max(initial=0)) + 1
    key, split = np.unique(faces.ravel() * span + groups.ravel(), return_inverse=True)
    return split.reshape(-1, 3).astype(np.int64), key // span, key % span


def _angles(a: F64, b: F64) -> F64:
    """Angles between unit vectors in radians; atan2 keeps its accuracy near 0 and pi."""
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    angles: F64 = np.arctan2(sine, np.einsum("ij,ij->i", a, b))
    return angles


def _azimuths(positions: F64, faces: I64, edges: Edges, normals: F64) -> F64:
    """Angle about the edge from the normal of its first face; 0 where one or two faces meet."""
    halves = np.flatnonzero(edges.n_faces_at[edges.edge_of] > 2)
    order, _ = around_edges(edges)
    first = order[np.cumsum(edges.n_faces_at) - edges.n_faces_at][edges.edge_of[halves]]
    along = positions[np.roll(faces, -1, axis=1).ravel()[halves]] - positions[faces.ravel()[halves]]
    along *= np.where(edges.forward[halves], 1.0, -1.0)[:, None]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    reference, normal = normals[first // 3], normals[halves // 3]
    azimuths = np.zeros(len(edges.edge_of))
    azimuths[halves] = np.arctan2(
        np.einsum("ij,ij->i", along, np.cross(reference, normal)),
        np.einsum("ij,ij->i", reference, normal),
    )
    return azimuths
