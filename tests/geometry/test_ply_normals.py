"""Normals of PLY files follow their vertices, also where trimesh splits and reorders these."""

import numpy as np
import pytest

from prtbake_workers.geometry.foreign_readers import read_foreign
from prtbake_workers.geometry.raw_mesh import MeshLimits

LIMITS = MeshLimits()
POSITIONS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [9, 9, 9]], np.float32)
# distinct, so that a mix-up shows
NORMALS = POSITIONS + np.array([0.5, 0.25, 2.0], np.float32)
LIST = "property list uchar int vertex_indices\n"
WEDGES = "property list uchar float texcoord\n"


def ply(rows, faces, *, n_faces, kind="ascii", names="x y z nx ny nz", lists=LIST):
    """Pack vertex rows of floats, and faces as they come."""
    properties = "".join(f"property float {name}\n" for name in names.split())
    header = (
        f"ply\nformat {kind} 1.0\nelement vertex {len(rows)}\n{properties}"
        f"element face {n_faces}\n{lists}end_header\n"
    )
    body = (
        "".join(" ".join(map(str, row)) + "\n" for row in rows.tolist()).encode()
        if kind == "ascii"
        else rows.astype("<f4").tobytes()
    )
    return header.encode() + body + faces


def check(raw, n_triangles=2):
    """Every corner has the normal that belongs to its position."""
    assert len(raw.faces) == n_triangles
    corners = raw.positions[raw.faces].reshape(-1, 3)
    normals = raw.normals[raw.faces].reshape(-1, 3)
    assert (normals == corners + np.array([0.5, 0.25, 2.0])).all()


TRIANGLES = np.array([[2, 3, 0], [0, 1, 2]], np.int32)
TEXT = b"3 2 3 0\n3 0 1 2\n"
PACKED = b"".join(b"\3" + row.tobytes() for row in TRIANGLES)
ROWS = np.hstack([POSITIONS, NORMALS])


@pytest.mark.parametrize(
    ("faces", "kind", "n_faces"),
    [
        (TEXT, "ascii", 2),
        (PACKED, "binary_little_endian", 2),
        (b"4 0 1 2 3\n", "ascii", 1),
        # faces of several sizes: trimesh sorts them by size
        (b"4 0 1 2 3\n3 2 3 0\n", "ascii", 2),
        (b"5 0 1 2 3 0\n3 1 2 3\n3 2 3 0\n", "ascii", 3),
    ],
)
def test_vertices_keep_their_normals(faces, kind, n_faces):
    raw = read_foreign(ply(ROWS, faces, n_faces=n_faces, kind=kind), "ply", LIMITS)
    check(raw, len(raw.faces))
    assert len(raw.positions) == 5


def test_they_do_where_vertices_have_texture_coordinates():
    rows = np.hstack([ROWS, np.array([[1, 0], [0, 0], [0, 1], [1, 1], [0, 0]], np.float32)])
    for kind, faces in (("ascii", TEXT), ("binary_little_endian", PACKED)):
        data = ply(rows, faces, n_faces=2, kind=kind, names="x y z nx ny nz s t")
        raw = read_foreign(data, "ply", LIMITS)
        check(raw)
        # the order is trimesh's, not the file's: what is tested here would else be for nothing
        assert raw.positions.tolist() != POSITIONS.tolist()


def test_they_do_where_corners_have_texture_coordinates():
    """Each face with its own: vertices are split, and both copies have the normal."""
    faces = b"3 2 3 0 6 0 0 1 0 0 1\n3 0 1 2 6 .5 .5 1 1 1 0\n"
    raw = read_foreign(ply(ROWS, faces, n_faces=2, lists=LIST + WEDGES), "ply", LIMITS)
    check(raw)
    assert len(raw.positions) == 6


def test_none_without_all_three():
    rows = np.hstack([POSITIONS, NORMALS[:, :2]])
    raw = read_foreign(ply(rows, TEXT, n_faces=2, names="x y z nx ny"), "ply", LIMITS)
    assert raw.normals is None


def test_points_alone_have_none():
    assert read_foreign(ply(ROWS, b"", n_faces=0), "ply", LIMITS).normals is None


def test_what_is_not_finite_becomes_zero():
    rows = ROWS.copy()
    rows[2, 4] = np.nan
    raw = read_foreign(ply(rows, TEXT, n_faces=2), "ply", LIMITS)
    assert raw.normals[2].tolist() == [0, 0, 0]
    assert raw.normals[1].tolist() == NORMALS[1].tolist()
