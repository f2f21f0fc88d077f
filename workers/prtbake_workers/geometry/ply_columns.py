"""Columns of the vertex table of a PLY file, by the vertices that trimesh made of it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh

from prtbake_workers.arrays import F64, I64

_CORNER_NAMES = ("vertex_index", "vertex_indices")


def ply_columns(mesh: Any, names: Sequence[str]) -> F64 | None:
    """Give the properties ``names`` for each vertex of ``mesh``; None where the file lacks one.

    trimesh splits vertices by texture coordinates and loses what else the file says of them; it
    keeps the table it read, though, and the order of the faces, by which each vertex finds its
    line.  Vertices that no face uses get zeros.
    """
    table = mesh.metadata.get("_ply_raw", {})
    vertices, faces = (table.get(name, {}).get("data") for name in ("vertex", "face"))
    if not len(getattr(mesh, "faces", ())) or not set(names) <= set(_names(vertices)):
        return None
    rows = np.column_stack([vertices[name] for name in names]).astype(np.float64)
    columns = np.zeros((len(mesh.vertices), len(names)))
    columns[np.asarray(mesh.faces).ravel()] = rows[_corners(faces).ravel()]
    return columns


def ply_types(mesh: Any) -> dict[str, str]:
    """Give the type of each property of a vertex, as numpy writes it without the order of bytes."""
    properties = mesh.metadata.get("_ply_raw", {}).get("vertex", {}).get("properties", {})
    return {name: str(kind).lstrip("<>=|") for name, kind in properties.items()}


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
