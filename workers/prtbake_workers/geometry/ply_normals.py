"""The vertex normals of a PLY file that trimesh has read."""

from typing import Any

from prtbake_workers.arrays import F64
from prtbake_workers.geometry.ply_columns import ply_columns

_NORMAL_NAMES = ("nx", "ny", "nz")


def ply_normals(mesh: Any) -> F64 | None:
    """Give the properties nx, ny, nz for each vertex of ``mesh``; None where the file has none."""
    return ply_columns(mesh, _NORMAL_NAMES)
