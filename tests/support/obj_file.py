"""Meshes as the text of an OBJ file."""

from collections.abc import Sequence

import numpy as np

from prtbake_workers.geometry.mesh import Mesh


def obj_bytes(meshes: Sequence[Mesh], *, coordinates: bool = False) -> bytes:
    """Write meshes one after the other, with normals and perhaps texture coordinates."""
    lines: list[str] = []
    first = 1
    for mesh in meshes:
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.positions.tolist()]
        lines += [f"vn {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.normals.tolist()]
        if coordinates:
            if mesh.uv is None:
                raise ValueError("a mesh without texture coordinates cannot have them written")
            lines += [f"vt {u:.9g} {v:.9g}" for u, v in mesh.uv.tolist()]
        for face in (np.asarray(mesh.faces, np.int64) + first).tolist():
            lines.append("f " + " ".join(f"{i}/{i if coordinates else ''}/{i}" for i in face))
        first += len(mesh.positions)
    return "\n".join(lines).encode()
