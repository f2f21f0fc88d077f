"""Wavefront OBJ: the lines ``v``, ``vt`` and ``f``; everything else is passed over.

Own reader, because trimesh refuses relative indices, drops the line number from its messages and
follows ``mtllib``.  No other file is ever opened from here.
"""

from array import array
from collections.abc import Iterator

import numpy as np

from prtbake_storage.errors import MeshError
from prtbake_workers.arrays import I64
from prtbake_workers.geometry.polygons import triangulate
from prtbake_workers.geometry.raw_mesh import MeshLimits, RawMesh


class _Contents:
    """Flat tables that the lines are read into."""

    def __init__(self) -> None:
        self.positions = array("d")
        self.uv = array("d")
        self.corner_positions = array("q")
        self.corner_uv = array("q")
        self.counts = array("q")
        self.lines = array("q")
        self.short_faces: list[int] = []


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
        texture coordinate alone: normals in the file are not read (they are often wrong, and
        the repair computes them), nor are materials, groups and colours.

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
    # -1 stands for "no texture coordinate"
    _check_indices(corner_uv[corner_uv != -1], len(uv), lines[corner_uv != -1], "vt")
    limits.check(triangles=int((counts - 2).sum()))
    triangles, _ = triangulate(positions, corners, counts)

    warnings = []
    if contents.short_faces:
        warnings.append(
            f"{len(contents.short_faces)} faces with fewer than three corners left out, "
            f"the first on line {contents.short_faces[0]}"
        )
    n_polygons = int(np.count_nonzero(counts > 3))
    n_short = len(contents.short_faces)
    if not (corner_uv >= 0).any():
        return RawMesh(
            positions, corners[triangles], None, None, n_polygons, n_short, warnings
        )  # fmt: skip
    # one vertex for each pair (v, vt); those that no face uses come last, for the repair to count
    key = corners * (len(uv) + 1) + corner_uv + 1
    unique, split = np.unique(key, return_inverse=True)
    label = unique // (len(uv) + 1)
    unused = np.setdiff1d(np.arange(len(positions)), label)
    label = np.concatenate([label, unused])
    uv_of = np.concatenate([unique % (len(uv) + 1) - 1, np.full(len(unused), -1)])
    split_uv = np.vstack([uv, [np.nan, np.nan]])[uv_of]
    limits.check(vertices=len(label))
    return RawMesh(
        positions[label], split[triangles], split_uv, label, n_polygons, n_short, warnings
    )


def _read_lines(data: bytes, limits: MeshLimits) -> _Contents:
    contents = _Contents()
    for number, words in _split_lines(data):
        keyword = words[0]
        if keyword == "v":
            _read_numbers(contents.positions, words, 3, number)
            limits.check(vertices=len(contents.positions) // 3)
        elif keyword == "vt":
            # one texture coordinate is legal; the second is then 0
            _read_numbers(contents.uv, words if len(words) > 2 else [*words, "0"], 2, number)
        elif keyword == "f":
            _read_face(contents, words, number, limits)
    return contents


def _split_lines(data: bytes) -> Iterator[tuple[int, list[str]]]:
    """Give number and words of each line; a backslash at its end joins the next one to it."""
    pending: list[str] = []
    # latin-1 reads any byte; only names and comments hold bytes beyond ASCII
    for number, line in enumerate(data.decode("latin-1").splitlines(), start=1):
        if "#" in line:
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


def _read_numbers(table: "array[float]", words: list[str], n: int, number: int) -> None:
    try:
        table.extend([float(word) for word in words[1 : n + 1]])
    except ValueError:
        raise MeshError(f"line {number}: '{_shown(words)}' holds something not a number") from None
    if len(words) <= n:
        raise MeshError(f"line {number}: '{_shown(words)}' has fewer than {n} numbers")


def _read_face(contents: _Contents, words: list[str], number: int, limits: MeshLimits) -> None:
    n_corners = len(words) - 1
    if n_corners < 3:
        contents.short_faces.append(number)
        return
    limits.check_polygon(n_corners, f"line {number}")
    n_positions, n_uv = len(contents.positions) // 3, len(contents.uv) // 2
    for word in words[1:]:
        fields = word.split("/")
        try:
            position = int(fields[0])
            uv = int(fields[1]) if len(fields) > 1 and fields[1] else None
        except ValueError:
            raise MeshError(f"line {number}: '{_shown(words)}' is not a face") from None
        if position == 0 or uv == 0:
            raise MeshError(f"line {number}: index 0 in a face; OBJ counts from 1")
        # a relative index counts back from the last element above this line
        position = position - 1 if position > 0 else n_positions + position
        if uv is None:
            uv = -1
        else:
            uv = uv - 1 if uv > 0 else n_uv + uv
            if uv < 0:
                raise MeshError(f"line {number}: a relative vt index points before the first one")
        if not 0 <= position < 2**40 or uv >= 2**40:
            raise MeshError(f"line {number}: vertex index {fields[0]} points nowhere")
        contents.corner_positions.append(position)
        contents.corner_uv.append(uv)
    contents.counts.append(n_corners)
    contents.lines.append(number)


def _check_indices(indices: I64, n: int, lines: I64, name: str) -> None:
    beyond = np.flatnonzero(indices >= n)
    if len(beyond):
        first = beyond[0]
        raise MeshError(
            f"line {lines[first]}: {name} index {indices[first] + 1} points nowhere; "
            f"the file has {n} of them"
        )


def _shown(words: list[str]) -> str:
    """Show the line again, cut so that a message stays readable."""
    return " ".join(words)[:60]
