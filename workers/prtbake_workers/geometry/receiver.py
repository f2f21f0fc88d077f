"""The plane under an object that catches its shadow."""

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import grid_mesh


def receiver_plane(
    bounds: Float64[F64, "2 3"],
    *,
    resolution: int,
    extent: float,
    gap: float,
    texture_repeats: float = 1.0,
) -> Mesh:
    """Make a square plane below the bounding box, centred on it, with normal +y.

    Parameters
    ----------
    bounds
        Lower and upper corner of the object.
    resolution
        Vertices along each side, at least 2.
    extent
        Length of a side in diagonals of the bounding box.
    gap
        Distance below the box, in diagonals too; 0 lets the object stand on the plane.
    texture_repeats
        How often a texture lies across each side.
    """
    if resolution < 2:
        raise SettingsError(
            f"receiver.resolution must be at least 2, not {resolution}",
            pointer="/receiver/resolution",
        )
    diagonal = float(np.linalg.norm(bounds[1] - bounds[0]))
    if not diagonal > 0.0:
        raise SettingsError("the object has no extent to put a receiver under")
    centre = 0.5 * (bounds[0] + bounds[1])
    unit = grid_mesh(resolution - 1, resolution - 1)
    positions = unit.positions * (extent * diagonal)
    positions += [centre[0], bounds[0, 1] - gap * diagonal, centre[2]]
    assert unit.uv is not None  # a grid has them
    uv = unit.uv * texture_repeats
    return Mesh(positions, unit.faces, unit.normals, uv)
