"""What a closed mesh can take of its own light: nothing if it is convex, little if it is scattered.

A closed connected surface that is convex at every edge is convex (van Heijenoort 1952), so one look
at each edge settles it.
"""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.geometry.mesh import Mesh, face_area_vectors
from prtbake_workers.geometry.topology import connected, find_edges
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice

CONVEX_TOLERANCE = 1e-6
"""Height above a face's plane, in diagonals, that still counts as in it (float32 positions)."""

MOST_PIECES = 1024
"""More are not looked at one against the other."""

DIRECTIONS = 4096


def _welded_faces(mesh: Mesh) -> Int64[I64, "tris 3"]:
    """Give corners by position: a seam of texture coordinates or normals is no edge."""
    _, welded = np.unique(mesh.positions, axis=0, return_inverse=True)
    faces: I64 = welded.reshape(-1)[mesh.faces].astype(np.int64)
    return faces


def _pieces(faces: Int64[I64, "tris 3"]) -> Int64[I64, " tris"]:
    """Give each face the number of its piece; pieces share no vertex."""
    left, right = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    of_vertex = connected(int(faces.max(initial=-1)) + 1, left, right)
    return np.asarray(np.unique(of_vertex[faces[:, 0]], return_inverse=True)[1], np.int64)


def _heights(
    mesh: Mesh, faces: Int64[I64, "tris 3"], piece: Int64[I64, " tris"]
) -> Float64[F64, " pieces"]:
    """Measure how far each piece's faces rise above their neighbours' planes.

    All are infinite where the surface is open.
    """
    edges = find_edges(faces)
    highest = np.zeros(int(piece.max()) + 1)
    if not (edges.n_faces_at == 2).all():
        return highest + np.inf
    area_vectors = face_area_vectors(mesh.positions, mesh.faces)
    lengths = np.linalg.norm(area_vectors, axis=1, keepdims=True)
    normals = area_vectors / np.where(lengths > 0.0, lengths, 1.0)
    corners = mesh.positions[mesh.faces].reshape(-1, 3)
    # half-edge 3 f + i leaves corner i of face f; across from it lies the corner after the next
    first, second = edges.pairs.T
    across = second - second % 3 + (second + 2) % 3
    height = ((corners[across] - corners[first]) * normals[first // 3]).sum(axis=1)
    np.maximum.at(highest, piece[first // 3], height)
    return highest


def convexity_defect(mesh: Mesh) -> float:
    """Measure how far faces rise above the planes of their neighbours, in bounding-box diagonals.

    Infinite for an open surface and for several pieces, which can shadow each other.
    """
    faces = _welded_faces(mesh)
    piece = _pieces(faces)
    if piece.max() > 0:
        return float("inf")
    return float(_heights(mesh, faces, piece)[0]) / mesh.diagonal


def scattered_shadows(mesh: Mesh, factorisation: Factorisation) -> float:
    """Bound what closed convex pieces take from each other by the spheres around them.

    From a piece i at ``c_i``, of radius ``r_i``, a piece j is seen within a cone of half angle
    ``asin(r_j / (|c_i - c_j| - r_i))``.  Light that is lost comes from these solid angles, with at
    most the largest squared transfer of any direction.

    Returns
    -------
    float
        Upper bound of the squared-error ratio of leaving the shadows out, at any point of the
        mesh; infinite where pieces are open, not convex, too near or too many, 0 for one.
    """
    faces = _welded_faces(mesh)
    piece = _pieces(faces)
    n_pieces = int(piece.max()) + 1
    if n_pieces > MOST_PIECES:
        return float("inf")
    centres, radii = np.zeros((n_pieces, 3)), np.zeros(n_pieces)
    for index in range(n_pieces):
        points = mesh.positions[mesh.faces[piece == index]].reshape(-1, 3)
        centres[index] = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radii[index] = np.linalg.norm(points - centres[index], axis=1).max()
    if (_heights(mesh, faces, piece) > 2.0 * CONVEX_TOLERANCE * radii).any():
        return float("inf")
    gap = np.linalg.norm(centres[:, None] - centres, axis=2) - radii[:, None]
    np.fill_diagonal(gap, np.inf)
    if (gap <= radii).any():
        return float("inf")
    solid_angle = 2.0 * np.pi * (1.0 - np.sqrt(1.0 - (radii / gap) ** 2)).sum(axis=1).max()
    largest, total = _squared_transfer(factorisation)
    lost = float(solid_angle) * largest
    return lost / (total - lost) if lost < total else float("inf")


def _squared_transfer(factorisation: Factorisation) -> tuple[float, float]:
    """Give the largest ``sum_k psi_k^2 cos^2`` of any direction, and its integral."""
    local: F64 = cosine_directions(lattice(DIRECTIONS))
    weighted = (factorisation.eval_psi(local) ** 2).sum(axis=1) * local[:, 2]
    return float((weighted * local[:, 2]).max()), float(np.pi * weighted.mean())
