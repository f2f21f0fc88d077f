"""The texels of a cube map, in plain numpy: where they lie, how large they are, which one is hit.

Faces are +x -x +y -y +z -z, row by row.  On the faces of x, y and z the columns run along z, x and
x and the rows along y, z and y, from -1 to 1 on the cube of half edge 1.
"""

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

N_FACES = 6


def face_points(resolution: int) -> F64:
    """Give the texel centres on the cube of half edge 1, (faces, rows, columns, 3)."""
    steps = (np.arange(resolution) + 0.5) / resolution * 2.0 - 1.0
    v, u = np.meshgrid(steps, steps, indexing="ij")
    one = np.ones_like(u)
    faces = [(one, v, u), (-one, v, u), (u, one, v), (u, -one, v), (u, v, one), (u, v, -one)]
    return np.stack([np.stack(face, axis=-1) for face in faces])


def face_solid_angles(resolution: int) -> F64:
    """Give the exact solid angles of one face's texels, (rows, columns), in sr; 4 pi / 6 in all.

    The rectangle between the middle of a face and (x, y) has ``atan(x y / sqrt(x^2 + y^2 + 1))``.
    """
    edges = np.linspace(-1.0, 1.0, resolution + 1)
    x, y = edges[:, None], edges[None, :]
    corner = np.arctan2(x * y, np.sqrt(x * x + y * y + 1.0))
    return np.asarray(corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1])


def cube_texels(resolution: int, parts: int = 1) -> tuple[F64, F64, I64]:
    """Cut every texel into ``parts`` x ``parts`` and give the parts' centres.

    Parameters
    ----------
    resolution
        N texels along an edge, at least 1.
    parts
        Along an edge of a texel, at least 1.

    Returns
    -------
    directions, solid_angles, owners
        (n, 3) unit; (n,) exact, sum 4 pi; (n,) the texel each part belongs to.
    """
    fine = resolution * parts
    points = face_points(fine).reshape(-1, 3)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    own = np.arange(fine) // parts
    texel = own[:, None] * resolution + own[None, :]
    owners = np.arange(N_FACES)[:, None, None] * resolution**2 + texel
    solid_angles = np.tile(face_solid_angles(fine).ravel(), N_FACES)
    return directions, solid_angles, owners.reshape(-1).astype(np.int64)


def cube_texel_of(directions: F64, resolution: int) -> I64:
    """Give the texel that each direction (n, 3) falls in; of an edge, one beside it."""
    axis = np.argmax(np.abs(directions), axis=1)
    rows = np.arange(len(directions))
    along = directions[rows, axis]
    # columns and rows of the faces, as `face_points` lays them out
    column_axis, row_axis = np.array([2, 0, 0])[axis], np.array([1, 2, 1])[axis]

    def step(across: I64) -> I64:
        place = (directions[rows, across] / np.abs(along) + 1.0) * (resolution / 2)
        cells: I64 = np.clip(np.floor(place).astype(np.int64), 0, resolution - 1)
        return cells

    face = 2 * axis + (along < 0)
    return np.asarray((face * resolution + step(row_axis)) * resolution + step(column_axis))
