"""Vertex colours of PLY, OFF and GLB files, which trimesh rounds to bytes or does not read.

Whole numbers are taken to be sRGB codes and numbers with a fraction to be linear, except those of
glTF, which are linear in all types [Khronos2021]_ 3.7.2.1.
"""

from typing import Any

import numpy as np

from prtbake_workers.arrays import F64
from prtbake_workers.geometry.file_checks import split_off
from prtbake_workers.geometry.glb_guard import COLOUR_ATTRIBUTE
from prtbake_workers.geometry.ply_columns import ply_columns, ply_types
from prtbake_workers.geometry.vertex_colours import Encoding, RawColours

_PLY_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_LARGEST = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
"""By type: what stands for 1."""


def ply_colours(mesh: Any, notes: list[str]) -> RawColours | None:
    """Give the properties red, green, blue of a PLY file: uchar and ushort as codes, or floats."""
    types = ply_types(mesh)
    names = next((names for names in _PLY_NAMES if set(names) <= set(types)), None)
    if names is None:
        return None
    kinds = {types[name] for name in names}
    kind = kinds.pop()
    if kinds or kind not in _LARGEST:
        notes.append(
            "the vertex colours are left out: they are not all uchar, ushort, float or double"
        )
        return None
    values = ply_columns(mesh, names)
    if values is None:
        return None
    return _plain(values / _LARGEST[kind], linear=kind[0] == "f")


def off_colours(data: bytes) -> RawColours | None:
    """Give the colours of a COFF file, three or four numbers behind each position.

    Writers put floats in [0, 1] or whole numbers up to 255 there: the file holds the latter where
    all are whole and one exceeds 1.
    """
    keyword, (_, counts), body = split_off(data)
    if keyword != "COFF":
        return None
    words = [line.split()[3:6] for _, line in body[: int(counts.split()[0])]]
    given = np.array([len(row) == 3 for row in words], np.bool_)
    rows = [row for row in words if len(row) == 3]
    values = np.ones((len(words), 3))
    values[given] = np.array([_numbers(row) for row in rows]).reshape(-1, 3)
    whole = all(word.isdecimal() for row in rows for word in row)
    codes = whole and bool((values > 1.0).any())
    return RawColours(values / 255.0 if codes else values, given, "srgb" if codes else "linear")


def glb_colours(mesh: Any, n_vertices: int) -> RawColours | None:
    """Give COLOR_0 of a part, without alpha."""
    given = getattr(mesh, "vertex_attributes", {}).get(COLOUR_ATTRIBUTE)
    if given is None or np.shape(given) not in {(n_vertices, 3), (n_vertices, 4)}:
        return None
    codes = np.asarray(given)[:, :3]
    values = codes.astype(np.float64) / _LARGEST[codes.dtype.str[1:]]
    return _plain(values, linear=True, clamped=True)


def _plain(values: F64, *, linear: bool, clamped: bool = False) -> RawColours:
    encoding: Encoding = "linear" if linear else "srgb"
    return RawColours(values, np.ones(len(values), np.bool_), encoding, clamped)


def _numbers(words: list[str]) -> list[float]:
    """Read numbers; NaN, which is refused later, where a word is none."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return [np.nan] * len(words)
