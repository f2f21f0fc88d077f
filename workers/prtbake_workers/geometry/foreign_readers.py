"""PLY, STL, OFF and GLB through trimesh, with the file checked before and the result after.

trimesh gets bytes and no resolver, so that nothing but the upload is ever read, and no
processing, so that the repair sees (and reports) the file as it is.
"""

import struct
import warnings
from io import BytesIO
from typing import Any

import numpy as np
import trimesh

from prtbake_storage.errors import MeshError
from prtbake_workers.arrays import F64, I64
from prtbake_workers.geometry.file_checks import (
    check_off,
    check_ply,
    check_ply_lists,
    check_stl,
)
from prtbake_workers.geometry.file_colours import glb_colours, off_colours, ply_colours
from prtbake_workers.geometry.glb_guard import NORMAL_ATTRIBUTE, UV_ATTRIBUTE, guard_glb
from prtbake_workers.geometry.ply_normals import ply_normals
from prtbake_workers.geometry.raw_mesh import MeshLimits, RawMesh
from prtbake_workers.geometry.vertex_colours import RawColours, join_colours

# what trimesh is known to raise on files that it cannot read
_READ_ERRORS = (
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError,
    MemoryError, NameError, OSError, RuntimeError, TypeError, ValueError, struct.error,
)  # fmt: skip


def read_foreign(data: bytes, format: str, limits: MeshLimits) -> RawMesh:
    """Parse ``data`` as ``format``: ply, stl, off or glb.

    Returns
    -------
    RawMesh
        All parts in one, each under its transform in the scene; a mirrored part is turned over
        so that its outside stays outside.  Those of a GLB are grouped, see `group_primitives`.
        The normals that an STL gives are those of its facets: they tell nothing about vertices,
        and are not read.

    Raises
    ------
    MeshError
        The file cannot be read.
    TooLarge
        It declares more than the limits allow.
    """
    notes: list[str] = []
    groups: dict[str, int] = {}
    group_names: list[str] = []
    if format == "ply":
        check_ply(data, limits)
    elif format == "stl":
        check_stl(data, limits)
    elif format == "off":
        check_off(data, limits)
    else:
        data, notes, groups, group_names = guard_glb(data, limits)
    parts = _read_parts(data, format)
    positions: list[F64] = []
    faces: list[I64] = []
    uvs: list[F64] = []
    normals: list[F64] = []
    colours: list[RawColours | None] = []
    part_groups: list[int] = []
    n_vertices = 0
    for name, mesh, transform in parts:
        points = np.asarray(mesh.vertices, np.float64)
        triangles = np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), np.int64)
        if not triangles.size:
            triangles = triangles.reshape(0, 3)
        elif triangles.shape[1:] != (3,):
            raise MeshError(f"{format.upper()}: the faces cannot be cut into triangles")
        limits.check(vertices=n_vertices + len(points), triangles=len(triangles))
        if not np.isfinite(transform).all():
            raise MeshError(f"{format}: a node's transform is not finite")
        with np.errstate(invalid="ignore", over="ignore"):
            placed = points @ transform[:3, :3].T + transform[:3, 3]
        # the repair refuses these with their index: it should show what the file says
        broken = ~np.isfinite(points).all(axis=1)
        placed[broken] = points[broken]
        positions.append(placed)
        if np.linalg.det(transform[:3, :3]) < 0.0:
            triangles = triangles[:, ::-1]
        _check_corners(triangles, len(points), format)
        faces.append(triangles + n_vertices)
        uvs.append(_uv_of(mesh, len(points)))
        normals.append(_normals_of(mesh, len(points), transform[:3, :3]))
        if format == "ply":
            colours.append(ply_colours(mesh, notes))
        elif format == "off":
            colours.append(off_colours(data))
        else:
            colours.append(glb_colours(mesh, len(points)))
        part_groups.append(groups.get(name, 0))
        n_vertices += len(points)
    if not positions:
        return RawMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), warnings=notes)
    uv, normal = np.concatenate(uvs), np.concatenate(normals)
    limits.check(vertices=n_vertices, triangles=sum(len(part) for part in faces))
    return RawMesh(
        np.concatenate(positions),
        np.concatenate(faces),
        uv if np.isfinite(uv).any() else None,
        warnings=notes,
        normals=normal if np.isfinite(normal).any() else None,
        colours=join_colours(colours, [len(part) for part in positions]),
        face_groups=np.repeat(np.array(part_groups, np.int64), [len(part) for part in faces])
        if groups
        else None,
        group_names=group_names,
    )


def _read_parts(data: bytes, format: str) -> list[tuple[str, Any, F64]]:
    """Run trimesh; name, mesh and world transform of each part, in the order of the file."""
    # materials bring pictures; the guard has taken them from a GLB
    options: dict[str, Any] = {} if format == "glb" else {"skip_materials": True}
    try:
        with warnings.catch_warnings():
            # numpy warns of text that it reads only in part
            warnings.simplefilter("error", DeprecationWarning)
            scene = trimesh.load_scene(
                BytesIO(data), file_type=format, process=False, resolver=None, **options
            )
            parts = []
            for node in scene.graph.nodes_geometry:
                transform, name = scene.graph[node]
                mesh = scene.geometry[name]
                # a cloud of points counts, so that the refusal can say what the file holds
                if isinstance(mesh, trimesh.Trimesh | trimesh.PointCloud):
                    parts.append((str(name), mesh, np.asarray(transform, np.float64)))
                if format == "ply":
                    check_ply_lists(mesh)
    except (*_READ_ERRORS, DeprecationWarning) as error:
        if isinstance(error, MeshError):
            raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise MeshError(f"the {format.upper()} file cannot be read: {reason}") from error
    return parts


def _uv_of(mesh: Any, n: int) -> F64:
    """Texture coordinates with the origin at the lower left; NaN where there are none."""
    custom = getattr(mesh, "vertex_attributes", {}).get(UV_ATTRIBUTE)
    given = getattr(getattr(mesh, "visual", None), "uv", None) if custom is None else custom
    if given is None or np.shape(given) != (n, 2):
        return np.full((n, 2), np.nan)
    uv: F64 = np.array(given, np.float64)
    if custom is not None:
        # glTF counts v from the top
        uv[:, 1] = 1.0 - uv[:, 1]
    return uv


def _normals_of(mesh: Any, n: int, linear: F64) -> F64:
    """Vertex normals under a node's transform: NaN where there are none, 0 where not finite."""
    given = getattr(mesh, "vertex_attributes", {}).get(NORMAL_ATTRIBUTE)
    if given is None:
        given = ply_normals(mesh)
    if given is None or np.shape(given) != (n, 3):
        return np.full((n, 3), np.nan)
    normals: F64 = np.array(given, np.float64)
    # a normal is a pair of tangents crossed, so it turns by the cofactors; their size is no matter
    a, b, c = linear / max(float(np.abs(linear).max()), np.finfo(np.float64).tiny)
    cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    if np.linalg.det(linear) < 0.0:
        # the triangles were turned over, and so keep their outside
        cofactors = -cofactors
    with np.errstate(invalid="ignore", over="ignore"):
        normals = normals @ cofactors.T
    normals[~np.isfinite(normals).all(axis=1)] = 0.0
    return normals


def _check_corners(triangles: I64, n: int, format: str) -> None:
    outside = np.flatnonzero((triangles < 0).any(axis=1) | (triangles >= n).any(axis=1))
    if len(outside):
        corners = ", ".join(str(int(i)) for i in triangles[outside[0]])
        raise MeshError(
            f"{format.upper()}: triangle {outside[0]} (counted from 0) has corners ({corners}), "
            f"but its part has {n} vertices"
        )
