"""Procedural shapes other than the teapot."""

import numpy as np

from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces
from prtbake_workers.geometry.mesh import Mesh


def sphere_mesh(subdivisions: int, *, radius: float = 1.0) -> Mesh:
    """Make an icosphere that sits on y = 0; its normals are those of the true sphere."""
    normals = icosphere(subdivisions)
    positions = radius * (normals + np.array([0.0, 1.0, 0.0]))
    return Mesh(positions, icosphere_faces(subdivisions), normals)


def grid_mesh(columns: int, rows: int) -> Mesh:
    """Make a square of (columns + 1) x (rows + 1) vertices: x and z in [-1/2, 1/2], normal +y.

    Texture coordinates run with x and against z, so that the picture lies upright seen from above
    with -z away from the viewer.
    """
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, columns + 1), np.linspace(-0.5, 0.5, rows + 1))
    positions = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)[None, :]).ravel()
    below = corner + columns + 1
    # alternate the diagonal so that the grid has no preferred direction
    odd = (np.arange(rows)[:, None] + np.arange(columns)[None, :]).ravel() % 2 == 1
    one = np.where(odd[:, None], np.stack([corner, below, corner + 1], 1),
                   np.stack([corner, below, below + 1], 1))  # fmt: skip
    two = np.where(odd[:, None], np.stack([corner + 1, below, below + 1], 1),
                   np.stack([corner, below + 1, corner + 1], 1))  # fmt: skip
    return Mesh(
        positions=positions,
        faces=np.stack([one, two], axis=1).reshape(-1, 3).astype(np.int32),
        normals=np.tile([0.0, 1.0, 0.0], (len(positions), 1)),
        uv=np.stack([x.ravel() + 0.5, 0.5 - z.ravel()], axis=1),
    )
