"""The vertex normals of a PLY file that trimesh has read."""

from typing import Any

import numpy as np
import trimesh

from prtbake_workers.arrays import F64, I64

_NORMAL_NAMES = ("nx", "ny", "nz")
_CORNER_NAMES = ("vertex_index", "vertex_indices")


def ply_normals(mesh: Any) -> F64 | None:
    """Give the properties nx, ny, nz for each vertex of ``mesh``; None where the file has none.

    trimesh splits vertices by texture coordinates and loses their normals; it keeps the table it
    read, though, and the order of the faces, by which each vertex finds its line.  Vertices that no
    face uses get 0 0 0.
    """
    table = mesh.metadata.get("_ply_raw", {})
    vertices, faces = (table.get(name, {}).get("data") for name in ("vertex", "face"))
    if not len(getattr(mesh, "faces", ())) or not set(_NORMAL_NAMES) <= set(_names(vertices)):
        return None
    rows = np.column_stack([vertices[name] for name in _NORMAL_NAMES]).astype(np.float64)
    normals = np.zeros((len(mesh.vertices), 3))
    normals[np.asarray(mesh.faces).ravel()] = rows[_corners(faces).ravel()]
    return normals


def _names(table: Any) -> tuple[str, ...]:
    """Names of the properties: text files become a dictionary, binary ones a structured array."""
    if isinstance(table, dict):
        return tuple(table)
    return tuple(getattr(getattr(table, "dtype", None), "names", None) or ())


def _corners(faces: Any) -> I64:
    """Triangles by the file's own vertices, cut as trimesh cuts them."""
    names = _names(faces)
    name = next((n for n in _CORNER_NAMES if n in names), names[0])
    polygons = faces[name] if isinstance(faces, dict) else faces[name]["f1"]
    triangles: I64 = trimesh.geometry.triangulate_quads(polygons)
    return triangles
