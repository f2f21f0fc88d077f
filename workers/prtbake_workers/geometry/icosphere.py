"""The icosphere: near-uniform points on the sphere by subdividing an icosahedron."""

from functools import cache

import numpy as np

from prtbake_workers.arrays import F64, I32, Float64, Int32

MAX_SUBDIVISIONS = 8


def icosphere(subdivisions: int) -> Float64[F64, "dirs 3"]:
    """Give the 12, 42, 162, 642, 2562, 10242 unit vectors for 0 to 5 subdivisions.

    The points of a coarser sphere are the first ones of each finer sphere.
    """
    return _subdivided(subdivisions)[0].copy()


def icosphere_faces(subdivisions: int) -> Int32[I32, "tris 3"]:
    """Triangles of the icosphere, counter-clockwise seen from outside."""
    return _subdivided(subdivisions)[1].copy()


@cache
def _subdivided(subdivisions: int) -> tuple[F64, I32]:
    if not 0 <= subdivisions <= MAX_SUBDIVISIONS:
        raise ValueError(f"subdivisions must lie in 0..{MAX_SUBDIVISIONS}, not {subdivisions}")
    if subdivisions == 0:
        return _icosahedron()
    points, faces = _subdivided(subdivisions - 1)
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, edge_of = np.unique(edges, axis=0, return_inverse=True)
    middles = points[unique].sum(axis=1)
    middles /= np.linalg.norm(middles, axis=1, keepdims=True)
    ab, bc, ca = (edge_of.reshape(-1, 3) + len(points)).T
    a, b, c = faces.T
    children = np.stack(
        [np.stack([a, ab, ca], 1), np.stack([b, bc, ab], 1), np.stack([c, ca, bc], 1),
         np.stack([ab, bc, ca], 1)], axis=1,
    ).reshape(-1, 3)  # fmt: skip
    return np.concatenate([points, middles]), children.astype(np.int32)


def _icosahedron() -> tuple[F64, I32]:
    """Poles on the y axis; two rings of five, turned by 36 degrees, at y = +-1/sqrt(5)."""
    angles = np.pi / 5.0 * np.arange(10)
    y = np.where(np.arange(10) % 2 == 0, 1.0, -1.0) / np.sqrt(5.0)
    radius = 2.0 / np.sqrt(5.0)
    ring = np.stack([radius * np.cos(angles), y, -radius * np.sin(angles)], axis=1)
    points = np.concatenate([[[0.0, 1.0, 0.0]], ring, [[0.0, -1.0, 0.0]]])
    faces = []
    for i in range(0, 10, 2):
        here, low, following, low_following = 1 + i, 2 + i, 1 + (i + 2) % 10, 2 + (i + 2) % 10
        faces += [
            (0, here, following),
            (here, low, following),
            (low, low_following, following),
            (11, low_following, low),
        ]
    return points, np.array(faces, np.int32)
