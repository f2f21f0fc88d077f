"""Checks of PLY, STL and OFF files before trimesh reads them.

They keep a header from promising more than the file holds (trimesh would allocate it, or read on
with what there is), and name the line at fault, which trimesh does not.
"""

import struct
from typing import Any

import numpy as np

from prtbake_storage.errors import MeshError
from prtbake_workers.geometry.raw_mesh import MeshLimits

_STL_HEADER_BYTES, _STL_TRIANGLE_BYTES = 84, 50
_MAX_HEADER_BYTES = 1 << 16
_LARGEST = {"uchar": 255, "uint8": 255, "ushort": 65535, "uint16": 65535}


def check_ply(data: bytes, limits: MeshLimits) -> None:
    """Refuse a header that promises more than the file holds, before anything is allocated."""
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    if not data[:3].lower() == b"ply" or end < 0:
        raise MeshError("PLY: the file has no header, or one that does not end")
    elements: list[tuple[str, int]] = []
    n_face_properties = 0
    vertex_properties: list[list[str]] = []
    header = data[:end].decode("latin-1").splitlines()
    for number, line in enumerate(header, start=1):
        words = line.split()
        if not words:
            raise MeshError(f"PLY: line {number} of the header is empty")
        if words[0] == "property" and elements and elements[-1][0] == "face":
            n_face_properties += 1
        if words[0] == "property" and elements and elements[-1][0] == "vertex":
            vertex_properties.append(words)
        if words[0] != "element":
            continue
        if len(words) != 3 or not words[2].isdecimal():
            raise MeshError(f"PLY: line {number}: '{line.strip()[:60]}' is not an element")
        name, count = words[1], int(words[2])
        elements.append((name, count))
        if name == "vertex":
            limits.check(vertices=count)
        elif name == "face":
            limits.check(triangles=count)
        elif name == "edge" and count:
            raise MeshError(f"PLY: line {number}: files with an element 'edge' are not read")
        # an element takes one byte at the least
        if count > len(data):
            raise MeshError(
                f"PLY: line {number}: {count} elements '{name[:20]}' in a file of {len(data)} bytes"
            )
    if any(b"ascii" in line for line in data[:end].splitlines()[1:2]):
        _check_ply_rows(data, len(header), elements, n_face_properties, limits)
        _check_ply_codes(data, len(header), elements, vertex_properties)


def _check_ply_rows(
    data: bytes,
    n_header: int,
    elements: list[tuple[str, int]],
    n_face_properties: int,
    limits: MeshLimits,
) -> None:
    """Refuse a text PLY with too few lines, or with faces that lack corners."""
    rows = data.decode("latin-1").splitlines()[n_header + 1 :]
    promised = sum(count for _, count in elements)
    if promised > len(rows):
        raise MeshError(f"PLY: the header promises {promised} lines, but {len(rows)} follow")
    start = 0
    for name, count in elements:
        # with more properties than the list of corners a row has no fixed length
        if name == "face" and n_face_properties == 1:
            for row, line in enumerate(rows[start : start + count], start=start):
                size, *corners = line.split() or [""]
                where = f"PLY: line {n_header + 2 + row}"
                if not size.isdecimal() or int(size) != len(corners):
                    raise MeshError(f"{where}: '{line[:60]}' is not a face")
                limits.check_polygon(int(size), where)
        start += count


def _check_ply_codes(
    data: bytes,
    n_header: int,
    elements: list[tuple[str, int]],
    properties: list[list[str]],
) -> None:
    """Refuse colours of a text PLY that are no codes of their type: they would come out wrapped."""
    if any(words[1:2] == ["list"] for words in properties):
        # then a vertex has no fixed columns
        return
    columns = {
        place: (words[1], _LARGEST[words[1]])
        for place, words in enumerate(properties)
        if len(words) == 3 and words[1] in _LARGEST and words[2].endswith(("red", "green", "blue"))
    }
    if not columns:
        return
    names = [name for name, _ in elements]
    at = names.index("vertex")
    start = sum(count for _, count in elements[:at])
    rows = data.decode("latin-1").splitlines()[n_header + 1 + start :]
    for vertex, line in enumerate(rows[: elements[at][1]]):
        words = line.split()
        for place, (kind, largest) in columns.items():
            if place < len(words) and not _is_code(words[place], largest):
                raise MeshError(
                    f"PLY: line {n_header + 2 + start + vertex}: the colour "
                    f"'{words[place][:20]}' of vertex {vertex} (counted from 0) is no {kind}"
                )


def _is_code(word: str, largest: int) -> bool:
    """Whether a word is a whole number from 0 to ``largest``, written as a fraction or not."""
    try:
        value = float(word)
    except ValueError:
        return False
    return 0 <= value <= largest and value == int(value)


def check_ply_lists(mesh: Any) -> None:
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


def check_stl(data: bytes, limits: MeshLimits) -> None:
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


def check_off(data: bytes, limits: MeshLimits) -> None:
    """Refuse an OFF whose counts exceed its lines, and polygons with too many corners."""
    _, (number, counts), body = split_off(data)
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


def split_off(data: bytes) -> tuple[str, tuple[int, str], list[tuple[int, str]]]:
    """Give keyword, counts and the lines after them; those that say something, with numbers."""
    lines = [
        (number, line.split("#", 1)[0].strip())
        for number, line in enumerate(data.decode("latin-1").splitlines(), start=1)
    ]
    lines = [(number, line) for number, line in lines if line]
    if not lines or lines[0][1].split()[0] not in ("OFF", "COFF"):
        raise MeshError("OFF: the file does not begin with 'OFF' or 'COFF'")
    (first, title), *rest = lines
    keyword, *counts = title.split(None, 1)
    # the counts may follow the keyword on its own line
    if counts:
        return keyword, (first, counts[0]), rest
    return keyword, rest[0] if rest else (first, ""), rest[1:]
