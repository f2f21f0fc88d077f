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
from prtbake_workers.geometry.glb_guard import UV_ATTRIBUTE, guard_glb
from prtbake_workers.geometry.raw_mesh import MeshLimits, RawMesh

# what trimesh is known to raise on files that it cannot read
_READ_ERRORS = (
    ArithmeticError, AssertionError, AttributeError, EOFError, ImportError, LookupError,
    MemoryError, NameError, OSError, RuntimeError, TypeError, ValueError, struct.error,
)  # fmt: skip

_STL_HEADER_BYTES, _STL_TRIANGLE_BYTES = 84, 50
_MAX_HEADER_BYTES = 1 << 16


def read_foreign(data: bytes, format: str, limits: MeshLimits) -> RawMesh:
    """Parse ``data`` as ``format``: ply, stl, off or glb.

    Returns
    -------
    RawMesh
        All parts in one, each under its transform in the scene; a mirrored part is turned over
        so that its outside stays outside.

    Raises
    ------
    MeshError
        The file cannot be read.
    TooLarge
        It declares more than the limits allow.
    """
    notes: list[str] = []
    if format == "ply":
        _check_ply(data, limits)
    elif format == "stl":
        _check_stl(data, limits)
    elif format == "off":
        _check_off(data, limits)
    else:
        data, notes = guard_glb(data, limits)
    parts = _read_parts(data, format)
    positions: list[F64] = []
    faces: list[I64] = []
    uvs: list[F64] = []
    n_vertices = 0
    for mesh, transform in parts:
        points = np.asarray(mesh.vertices, np.float64)
        triangles = np.asarray(getattr(mesh, "faces", np.zeros((0, 3))), np.int64)
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
        n_vertices += len(points)
    if not positions:
        return RawMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64), warnings=notes)
    uv = np.concatenate(uvs)
    limits.check(vertices=n_vertices, triangles=sum(len(part) for part in faces))
    return RawMesh(
        np.concatenate(positions),
        np.concatenate(faces),
        uv if np.isfinite(uv).any() else None,
        warnings=notes,
    )


def _read_parts(data: bytes, format: str) -> list[tuple[Any, F64]]:
    """Run trimesh; the meshes and their world transforms, in the order of the file."""
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
                    parts.append((mesh, np.asarray(transform, np.float64)))
                if format == "ply":
                    _check_ply_lists(mesh)
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


def _check_corners(triangles: I64, n: int, format: str) -> None:
    outside = np.flatnonzero((triangles < 0).any(axis=1) | (triangles >= n).any(axis=1))
    if len(outside):
        corners = ", ".join(str(int(i)) for i in triangles[outside[0]])
        raise MeshError(
            f"{format.upper()}: triangle {outside[0]} (counted from 0) has corners ({corners}), "
            f"but its part has {n} vertices"
        )


def _check_ply(data: bytes, limits: MeshLimits) -> None:
    """Refuse a header that promises more than the file holds, before anything is allocated."""
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    if not data[:3].lower() == b"ply" or end < 0:
        raise MeshError("PLY: the file has no header, or one that does not end")
    text = data[:end].decode("latin-1").splitlines()
    for number, line in enumerate(text, start=1):
        words = line.split()
        if not words:
            raise MeshError(f"PLY: line {number} of the header is empty")
        if words[0] != "element":
            continue
        if len(words) != 3 or not words[2].isdecimal():
            raise MeshError(f"PLY: line {number}: '{line.strip()[:60]}' is not an element")
        count = int(words[2])
        if words[1] == "vertex":
            limits.check(vertices=count)
        elif words[1] == "face":
            limits.check(triangles=count)
        elif words[1] == "edge" and count:
            raise MeshError(f"PLY: line {number}: files with an element 'edge' are not read")
        # the smallest element is one byte, in a text file a digit and a space
        if count > len(data):
            raise MeshError(
                f"PLY: line {number}: {count} elements '{words[1][:20]}' in a file of "
                f"{len(data)} bytes"
            )


def _check_ply_lists(mesh: Any) -> None:
    """Refuse a binary PLY whose faces differ in size: trimesh reads all as the first."""
    face = mesh.metadata.get("_ply_raw", {}).get("face", {}).get("data")
    for name in getattr(getattr(face, "dtype", None), "names", None) or ():
        column = face[name]
        if column.dtype.names and np.any(column["f0"] != column["f0"][:1]):
            first = int(np.flatnonzero(column["f0"] != column["f0"][0])[0])
            raise MeshError(
                f"PLY: face {first} has {column['f0'][first]} corners and face 0 has "
                f"{column['f0'][0]}; a binary PLY is read only if all are alike"
            )


def _check_stl(data: bytes, limits: MeshLimits) -> None:
    """Refuse an STL that is neither a whole binary file nor text."""
    n_bytes = len(data) - _STL_HEADER_BYTES
    if n_bytes >= 0:
        (count,) = struct.unpack_from("<I", data, 80)
        if count * _STL_TRIANGLE_BYTES == n_bytes:
            limits.check(triangles=count, vertices=3 * count)
            return
        if not data.lstrip()[:5].lower() == b"solid":
            raise MeshError(
                f"STL: the header promises {count} triangles ({count * _STL_TRIANGLE_BYTES} "
                f"bytes), but {n_bytes} bytes follow"
            )
    if b"endsolid" not in data.lower():
        raise MeshError("STL: neither a binary file nor text that ends with 'endsolid'")


def _check_off(data: bytes, limits: MeshLimits) -> None:
    """Refuse an OFF whose counts exceed its lines, and polygons with too many corners."""
    lines = [
        (number, line.split("#", 1)[0].strip())
        for number, line in enumerate(data.decode("latin-1").splitlines(), start=1)
    ]
    lines = [(number, line) for number, line in lines if line]
    if not lines or lines[0][1].split()[0] not in ("OFF", "COFF"):
        raise MeshError("OFF: the file does not begin with 'OFF' or 'COFF'")
    # the counts may follow the keyword on its own line
    number, counts = (
        (lines[0][0], lines[0][1].split(None, 1)[1]) if len(lines[0][1].split()) > 1
        else lines[1] if len(lines) > 1 else (lines[0][0], "")
    )  # fmt: skip
    body = lines[1:] if len(lines[0][1].split()) > 1 else lines[2:]
    words = counts.split()
    if len(words) < 2 or not all(word.isdecimal() for word in words[:2]):
        raise MeshError(f"OFF: line {number}: '{counts[:60]}' does not give the counts")
    n_vertices, n_faces = int(words[0]), int(words[1])
    limits.check(vertices=n_vertices, triangles=n_faces)
    if n_vertices + n_faces > len(body):
        raise MeshError(
            f"OFF: line {number} promises {n_vertices} vertices and {n_faces} faces, but "
            f"{len(body)} lines follow"
        )
    for number, line in body[:n_vertices]:
        if len(line.split()) < 3:
            raise MeshError(f"OFF: line {number}: '{line[:60]}' is not a position")
    for number, line in body[n_vertices : n_vertices + n_faces]:
        size, *corners = line.split()
        if not size.isdecimal() or len(corners) < int(size):
            raise MeshError(f"OFF: line {number}: '{line[:60]}' is not a face")
        limits.check_polygon(int(size), f"OFF: line {number}")
        outside = [
            word for word in corners[: int(size)] if not word.isdecimal() or int(word) >= n_vertices
        ]
        if outside:
            raise MeshError(
                f"OFF: line {number}: corner {outside[0]} points nowhere; the file has "
                f"{n_vertices} vertices"
            )
