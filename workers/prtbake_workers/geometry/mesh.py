"""The triangle mesh that every stage reads, and its normals and areas."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, I64, Float32, Float64, Int, Int32

UP = (0.0, 1.0, 0.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A repaired triangle mesh.

    Attributes
    ----------
    positions
        Vertex positions, right-handed, y up, in the file's own unit.
    faces
        Corner indices, counter-clockwise seen from outside.
    normals
        Unit vertex normals, equal for vertices that differ in UV or colour alone.
    uv
        Texture coordinates, origin at the lower left, or None.
    colours
        Linear Rec.709 in [0, 1], or None.
    face_groups
        Group of each triangle, an index of ``group_names``; None where there are no groups.
    group_names
        Distinct names, every one with a triangle.
    """

    positions: Float64[F64, "verts 3"]
    faces: Int32[I32, "tris 3"]
    normals: Float64[F64, "verts 3"]
    uv: Float64[F64, "verts 2"] | None = None
    colours: Float32[F32, "verts 3"] | None = None
    face_groups: Int32[I32, " tris"] | None = None
    group_names: tuple[str, ...] = ()

    @property
    def n_vertices(self) -> int:
        """Number of vertices; splits by UV, normal, crease or colour count."""
        return len(self.positions)

    @property
    def n_faces(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    @cached_property
    def bounds(self) -> Float64[F64, "2 3"]:
        """Lower and upper corner of the bounding box."""
        return np.stack([self.positions.min(axis=0), self.positions.max(axis=0)])

    @cached_property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @cached_property
    def vertex_areas(self) -> Float64[F64, " verts"]:
        """A third of the area of the triangles around each vertex; they sum to the surface area."""
        return vertex_areas(self.positions, self.faces)


def face_area_vectors(
    positions: Float64[F64, "verts 3"], faces: Int[I32 | I64, "tris 3"]
) -> Float64[F64, "tris 3"]:
    """Half the cross product of two edges: normal direction, and the area as length."""
    a, b, c = (positions[faces[:, corner]] for corner in range(3))
    vectors: F64 = 0.5 * np.cross(b - a, c - a)
    return vectors


def vertex_areas(
    positions: Float64[F64, "verts 3"], faces: Int[I32 | I64, "tris 3"]
) -> Float64[F64, " verts"]:
    """Share each triangle's area among its corners, a third each."""
    thirds = np.linalg.norm(face_area_vectors(positions, faces), axis=1) / 3.0
    areas: F64 = np.bincount(
        faces.ravel(), weights=np.repeat(thirds, 3), minlength=len(positions)
    ).astype(np.float64)
    return areas


def corner_angles(
    positions: Float64[F64, "verts 3"], faces: Int[I32 | I64, "tris 3"]
) -> Float64[F64, "tris 3"]:
    """Interior angle at each corner, in radians; each row sums to pi.

    atan2 of cross and dot product keeps its accuracy where acos of the dot product loses it, at
    angles near 0 and pi.
    """
    corners = positions[faces]
    angles = np.empty((len(faces), 3))
    for corner in range(3):
        to_next = corners[:, (corner + 1) % 3] - corners[:, corner]
        to_last = corners[:, (corner + 2) % 3] - corners[:, corner]
        sine = np.linalg.norm(np.cross(to_next, to_last), axis=1)
        angles[:, corner] = np.arctan2(sine, np.einsum("ij,ij->i", to_next, to_last))
    return angles


def vertex_normals(
    positions: Float64[F64, "verts 3"],
    faces: Int[I32 | I64, "tris 3"],
    groups: Int[I64, " verts"] | None = None,
) -> Float64[F64, "verts 3"]:
    """Mean of the adjacent face normals, weighted by the angle of the corner.

    The angle weight makes the normal independent of how the surface is cut into triangles
    (Thürmer and Wüthrich 1998).

    Parameters
    ----------
    positions, faces
        The surface.
    groups
        Vertices with one group number share one normal: those on the two sides of a UV seam.
        None keeps each vertex to itself.

    Returns
    -------
    array
        Unit normals.  Where the faces cancel (a sheet folded onto itself) the normal of one
        adjacent face stands in, and straight up where a vertex has none.
    """
    owner = np.arange(len(positions)) if groups is None else groups
    area_vectors = face_area_vectors(positions, faces)
    lengths = np.linalg.norm(area_vectors, axis=1, keepdims=True)
    face_normals = area_vectors / np.where(lengths > 0.0, lengths, 1.0)
    weights = corner_angles(positions, faces).ravel()
    owners = owner[faces].ravel()
    n_owners = int(owner.max()) + 1 if len(owner) else 0
    sums = np.stack(
        [
            np.bincount(owners, np.repeat(face_normals[:, axis], 3) * weights, minlength=n_owners)
            for axis in range(3)
        ],
        axis=1,
    )
    total_weight = np.bincount(owners, weights, minlength=n_owners)
    norms = np.linalg.norm(sums, axis=1)
    # the faces cancel when what is left of the sum is rounding
    cancelled = norms <= 1e-9 * total_weight
    if cancelled.any():
        stand_in = np.tile(np.array(UP), (n_owners, 1))
        stand_in[owners[::-1]] = np.repeat(face_normals, 3, axis=0)[::-1]
        usable = np.linalg.norm(stand_in, axis=1) > 0.5
        stand_in[~usable] = UP
        sums[cancelled] = stand_in[cancelled]
        norms[cancelled] = 1.0
    normals: F64 = (sums / norms[:, None])[owner]
    return normals
