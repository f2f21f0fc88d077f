"""A mesh cut into the parts that its faces belong to."""

import numpy as np

from prtbake_workers.arrays import I64, Int64
from prtbake_workers.geometry.mesh import Mesh


def split_mesh(mesh: Mesh, part_of_face: Int64[I64, " tris"]) -> list[Mesh]:
    """Cut a mesh along the borders of its parts.

    Parameters
    ----------
    mesh
        The whole.
    part_of_face
        Part of each triangle: 0, 1, ... without a gap.

    Returns
    -------
    list
        One mesh a part, vertices and faces in the order of the whole.  A vertex on a border is in
        all parts that meet there, with the one normal that the whole mesh has in it: a border is
        no crease.
    """
    parts = []
    for part in range(int(part_of_face.max()) + 1):
        used, corners = np.unique(mesh.faces[part_of_face == part], return_inverse=True)
        parts.append(
            Mesh(
                positions=mesh.positions[used],
                faces=corners.reshape(-1, 3).astype(np.int32),
                normals=mesh.normals[used],
                uv=None if mesh.uv is None else mesh.uv[used],
                colours=None if mesh.colours is None else mesh.colours[used],
            )
        )
    return parts
