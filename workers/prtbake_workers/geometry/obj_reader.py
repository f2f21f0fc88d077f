"""Wavefront OBJ: the lines ``v``, ``vt``, ``vn``, ``f`` and ``usemtl``; all else is passed over.

Own reader, because trimesh refuses relative indices, drops the line number from its messages and
follows ``mtllib``.  No other file is ever opened from here.
"""

import math
from array import array
from collections.abc import Iterator

import numpy as np

from prtbake_storage.errors import MeshError, PrtError
from prtbake_workers.arrays import F64, I64
from prtbake_workers.geometry.polygons import triangulate
from prtbake_workers.geometry.raw_mesh import MeshLimits, RawMesh
from prtbake_workers.geometry.vertex_colours import RawColours

_NONE, _BELOW = -1, -2
_MEANING = {
    "v": "a position: three numbers",
    "vt": "a texture coordinate: two numbers",
    "f": "a face: indices v, v/vt, v//vn or v/vt/vn",
}


class _Contents:
    """Flat tables that the lines are read into."""

    def __init__(self) -> None:
        self.positions = array("d")
        self.colours = array("d")
        self.coloured = array("q")
        self.uv = array("d")
        self.normals = array("d")
        self.corner_positions = array("q")
        self.corner_uv = array("q")
        self.corner_normals = array("q")
        self.counts = array("q")
        self.lines = array("q")
        self.short_faces: list[int] = []
        self.group_names: dict[str, int] = {}
        self.groups = array("q")


def read_obj(data: bytes, limits: MeshLimits) -> RawMesh:
    """Parse an OBJ file.

    Parameters
    ----------
    data
        The file.  Bytes that are not ASCII may stand in names and comments.
    limits
        Bounds on vertices, triangles and corners of a polygon.

    Returns
    -------
    RawMesh
        Polygons cut into triangles, relative (negative) indices resolved, vertices split by
        texture coordinate and normal.  Faces are grouped by the name of their material; no material
        is read.  Colours, ``v x y z r g b``, are taken as sRGB codes, which is what Blender and
        MeshLab write; the format does not say.  A normal or colour that cannot be read does not
        make the file unreadable: the repair computes normals and leaves colours out.

    Raises
    ------
    MeshError
        A line cannot be read or an index points nowhere; the message names the line.
    TooLarge
        A limit is exceeded.
    """
    contents = _read_lines(data, limits)
    positions = np.frombuffer(contents.positions, np.float64).reshape(-1, 3)
    uv = np.frombuffer(contents.uv, np.float64).reshape(-1, 2)
    corners = np.frombuffer(contents.corner_positions, np.int64)
    corner_uv = np.frombuffer(contents.corner_uv, np.int64)
    counts = np.frombuffer(contents.counts, np.int64)
    lines = np.repeat(np.frombuffer(contents.lines, np.int64), counts)
    _check_indices(corners, len(positions), lines, "vertex")
    has_uv = corner_uv != _NONE
    _check_indices(corner_uv[has_uv], len(uv), lines[has_uv], "texture coordinate")
    limits.check(triangles=int((counts - 2).sum()))
    triangles, polygon = triangulate(positions, corners, counts)

    has_groups = list(contents.group_names) != [""]
    warnings = []
    if contents.short_faces:
        warnings.append(
            f"{len(contents.short_faces)} faces with fewer than three corners left out, "
            f"the first on line {contents.short_faces[0]}"
        )
    normals, corner_normals = _usable_normals(contents, lines, warnings)
    label, uv_of, normal_of, split = _split_vertices(
        len(positions), corners, (corner_uv, len(uv)), (corner_normals, len(normals))
    )
    limits.check(vertices=len(label))
    return RawMesh(
        positions=positions[label],
        faces=split[triangles],
        uv=np.vstack([uv, [np.nan] * 2])[uv_of] if has_uv.any() else None,
        vertex_labels=label,
        n_polygons=int(np.count_nonzero(counts > 3)),
        n_short_faces=len(contents.short_faces),
        warnings=warnings,
        normals=np.vstack([normals, [np.nan] * 3])[normal_of] if len(normals) else None,
        colours=None if (colours := _colours(contents)) is None else colours.take(label),
        face_groups=np.frombuffer(contents.groups, np.int64)[polygon] if has_groups else None,
        group_names=list(contents.group_names),
    )


def _colours(contents: _Contents) -> RawColours | None:
    """Give the colours of the lines ``v``; None where no line has one."""
    if not contents.coloured:
        return None
    rows = np.frombuffer(contents.coloured, np.int64)
    n = len(contents.positions) // 3
    values, given = np.ones((n, 3)), np.zeros(n, np.bool_)
    values[rows] = np.frombuffer(contents.colours, np.float64).reshape(-1, 3)
    given[rows] = True
    return RawColours(values, given, "srgb")


def _usable_normals(contents: _Contents, lines: I64, warnings: list[str]) -> tuple[F64, I64]:
    """Give the normals, 0 0 0 for what is not finite, and their indices; none if no corner has one.

    An index that points nowhere counts as none: many tools drop the normals and leave the indices.
    """
    normals = np.frombuffer(contents.normals, np.float64).reshape(-1, 3)
    index = np.frombuffer(contents.corner_normals, np.int64)
    astray = np.flatnonzero((index != _NONE) & ((index < 0) | (index >= len(normals))))
    if len(astray):
        warnings.append(
            f"{len(astray)} corners name a normal that the file does not hold, the first on line "
            f"{lines[astray[0]]}: computed"
        )
        index = index.copy()
        index[astray] = _NONE
    if (index == _NONE).all():
        return np.zeros((0, 3)), np.full(len(index), _NONE, np.int64)
    return np.where(np.isfinite(normals).all(axis=1, keepdims=True), normals, 0.0), index


def _split_vertices(
    n_positions: int, corners: I64, uv: tuple[I64, int], normals: tuple[I64, int]
) -> tuple[I64, I64, I64, I64]:
    """Make one vertex for each triple (v, vt, vn); those that no face uses come last.

    Returns position, texture coordinate and normal of each vertex (-1 for none), and the vertex of
    each corner.  ``uv`` and ``normals`` are the corners' indices and the counts.
    """
    if (uv[0] == _NONE).all() and (normals[0] == _NONE).all():
        every = np.arange(n_positions)
        return every, np.full(n_positions, _NONE), np.full(n_positions, _NONE), corners
    split = corners
    for index, count in (uv, normals):
        # numbered anew after each table, so that the products stay within 64 bits
        _, first, split = np.unique(
            split * (count + 1) + index + 1, return_index=True, return_inverse=True
        )
    label = corners[first]
    unused = np.setdiff1d(np.arange(n_positions), label)
    none = np.full(len(unused), _NONE)
    return (
        np.concatenate([label, unused]),
        np.concatenate([uv[0][first], none]),
        np.concatenate([normals[0][first], none]),
        split.astype(np.int64),
    )


def _read_lines(data: bytes, limits: MeshLimits) -> _Contents:
    """Fill the tables; one loop without calls, because files have 100,000 lines and more."""
    contents = _Contents()
    positions, uvs, normals = contents.positions, contents.uv, contents.normals
    n_positions = n_uvs = n_normals = 0
    group_names, material = contents.group_names, ""
    for number, words in _split_lines(data):
        keyword, values = words[0], words[1:]
        try:
            if keyword == "v":
                x, y, z = values[:3]
                positions.extend((float(x), float(y), float(z)))
                if len(values) > 5:
                    contents.colours.extend(_read_three(values[3:], math.nan))
                    contents.coloured.append(n_positions)
                n_positions += 1
                if n_positions > limits.vertices:
                    limits.check(vertices=n_positions)
            elif keyword == "vt":
                # one texture coordinate is legal; the second is then 0
                u, v = values[:2] if len(values) > 1 else (*values, "0")
                uvs.extend((float(u), float(v)))
                n_uvs += 1
            elif keyword == "vn":
                # no surface has the normal 0 0 0
                normals.extend(_read_three(values, 0.0))
                n_normals += 1
            elif keyword == "f":
                if len(values) < 3:
                    contents.short_faces.append(number)
                    continue
                if len(values) > limits.polygon_corners:
                    limits.check_polygon(len(values), f"line {number}")
                for value in values:
                    fields = value.split("/")
                    # a relative index counts back from the last element above this line; where it
                    # leads below 0 the check of all indices finds it
                    index = int(fields[0])
                    index = index - 1 if index > 0 else n_positions + index if index else _BELOW
                    contents.corner_positions.append(index)
                    if len(fields) > 1 and fields[1]:
                        index = int(fields[1])
                        index = index - 1 if index > 0 else n_uvs + index if index else _BELOW
                        contents.corner_uv.append(index if index >= 0 else _BELOW)
                    else:
                        contents.corner_uv.append(_NONE)
                    if len(fields) > 2 and fields[2]:
                        index = int(fields[2])
                        index = index - 1 if index > 0 else n_normals + index if index else _BELOW
                        contents.corner_normals.append(index if index >= 0 else _BELOW)
                    else:
                        contents.corner_normals.append(_NONE)
                contents.counts.append(len(values))
                contents.lines.append(number)
                contents.groups.append(group_names.setdefault(material, len(group_names)))
            elif keyword == "usemtl":
                material = " ".join(values)
        except PrtError:
            raise
        except (ValueError, OverflowError):
            raise MeshError(
                f"line {number}: '{' '.join(words)[:60]}' cannot be read as {_MEANING[keyword]}"
            ) from None
    return contents


def _read_three(values: list[str], instead: float) -> tuple[float, float, float]:
    """Read three numbers; thrice ``instead`` where they are none."""
    try:
        x, y, z = values[:3]
        return float(x), float(y), float(z)
    except ValueError:
        return instead, instead, instead


def _split_lines(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Give number and words of each line; a backslash at its end joins the next one to it."""
    pending: list[str] = []
    for number, row in enumerate(data.splitlines(), start=1):
        # only names and comments hold bytes beyond ASCII
        line = row.decode("utf-8", "replace")
        # materials are often called material#1
        if "#" in line and not line.lstrip().startswith("usemtl"):
            line = line[: line.index("#")]
        words = line.split()
        if words and words[-1].endswith("\\"):
            words[-1] = words[-1][:-1]
            pending += [word for word in words if word]
            continue
        if pending:
            words, pending = pending + words, []
        if words:
            yield number, words
    if pending:
        yield number, pending


def _check_indices(indices: I64, n: int, lines: I64, name: str) -> None:
    outside = np.flatnonzero((indices < 0) | (indices >= n))
    if len(outside):
        first = outside[0]
        given = (
            f"index {indices[first] + 1}" if indices[first] >= n else "index 0 or a relative one"
        )
        raise MeshError(
            f"line {lines[first]}: {given} of a {name} points nowhere; the file has {n} of them"
        )
