"""The OBJ reader: what it reads, and what it says of files that it cannot read."""

import numpy as np
import pytest

from prtbake_storage.errors import MeshError, TooLarge
from prtbake_workers.geometry.obj_reader import read_obj
from prtbake_workers.geometry.raw_mesh import MeshLimits

LIMITS = MeshLimits()
TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def read(text, limits=LIMITS):
    return read_obj(text.encode("latin-1"), limits)


def test_plain_triangle():
    raw = read(TRIANGLE + "f 1 2 3\n")
    assert raw.positions.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert raw.faces.tolist() == [[0, 1, 2]]
    assert raw.uv is None


@pytest.mark.parametrize("face", ["f -3 -2 -1", "f 1// 2// 3//", "f 1//7 2//8 3//9", "f 1 \\\n2 3"])
def test_spellings_of_the_same_face(face):
    assert read(TRIANGLE + face).faces.tolist() == [[0, 1, 2]]


def test_relative_indices_count_from_the_line_they_stand_on():
    text = TRIANGLE + "f -3 -2 -1\nv 0 0 5\nv 1 0 5\nv 0 1 5\nf -3 -2 -1\n"
    assert read(text).faces.tolist() == [[0, 1, 2], [3, 4, 5]]


def test_vertices_split_where_texture_coordinates_differ():
    text = TRIANGLE + "v 1 1 0\nvt 0 0\nvt 1 0\nvt 0.5 0.5\nf 1/1 2/2 3/3\nf 2/2 4/1 3/1\n"
    raw = read(text)
    assert len(raw.positions) == 5
    corners = raw.positions[raw.faces]
    assert corners[1].tolist() == [[1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert raw.uv[raw.faces[1]].tolist() == [[1, 0], [0, 0], [0, 0]]
    assert raw.uv[raw.faces[0, 2]].tolist() == [0.5, 0.5]


def test_corner_without_texture_coordinate_gets_nan():
    raw = read(TRIANGLE + "vt 0.5 0.5\nf 1/1 2 3/1\n")
    assert np.isnan(raw.uv[raw.faces[0, 1]]).all()
    assert raw.uv[raw.faces[0, 0]].tolist() == [0.5, 0.5]


NORMALS = "vn 0 0 1\nvn 0 1 1\nvn 0 0 -2\n"


def test_vertices_split_where_normals_differ():
    raw = read(TRIANGLE + "v 1 1 0\n" + NORMALS + "f 1//1 2//1 3//1\nf 2//2 4//3 3//1\n")
    assert raw.vertex_labels.tolist() == [0, 1, 1, 2, 3]
    assert raw.normals.tolist() == [[0, 0, 1], [0, 0, 1], [0, 1, 1], [0, 0, 1], [0, 0, -2]]
    assert raw.faces.tolist() == [[0, 1, 3], [2, 4, 3]]
    assert raw.uv is None
    # relative ones count from their line
    again = read(TRIANGLE + "v 1 1 0\n" + NORMALS + "f 1//-3 2//-3 3//-3\nf 2//-2 4//-1 3//-3\n")
    assert again.normals.tolist() == raw.normals.tolist()


def test_position_uv_and_normal_each_split():
    text = TRIANGLE + NORMALS + "vt 0 0\nvt 1 0\nf 1/1/1 2/1/1 3/1/1\nf 1/2/1 3/1/2 2/1/1\n"
    raw = read(text)
    assert raw.vertex_labels.tolist() == [0, 0, 1, 2, 2]
    assert raw.faces.tolist() == [[0, 2, 3], [1, 4, 2]]
    assert raw.uv[:, 0].tolist() == [0, 1, 0, 0, 0]
    assert raw.normals[:, 1].tolist() == [0, 0, 0, 0, 1]


def test_normals_that_no_corner_names_split_nothing():
    plain = read(TRIANGLE + "f 1 2 3\n")
    for text in (TRIANGLE + NORMALS + "f 1 2 3\n", TRIANGLE + NORMALS + "f 1// 2// 3//\n"):
        raw = read(text)
        assert raw.normals is None
        assert raw.positions.tobytes() == plain.positions.tobytes()
        assert raw.faces.tobytes() == plain.faces.tobytes()


def test_corner_without_normal_gets_nan():
    raw = read(TRIANGLE + NORMALS + "f 1//1 2 3//1\n")
    assert np.isnan(raw.normals[1]).all()
    assert raw.normals[[0, 2]].tolist() == [[0, 0, 1], [0, 0, 1]]


@pytest.mark.parametrize("line", ["vn 0 1", "vn", "vn a b c", "vn 0 nan 1", "vn 0 1e999 0"])
def test_normals_that_cannot_be_read_are_zero_and_keep_the_numbering(line):
    raw = read(TRIANGLE + line + "\n" + NORMALS + "f 1//1 2//2 3//3\n")
    assert raw.normals.tolist() == [[0, 0, 0], [0, 0, 1], [0, 1, 1]]
    assert raw.warnings == []


@pytest.mark.parametrize("index", ["4", "-4", "0", "99999"])
def test_normals_that_point_nowhere_are_none_and_said(index):
    raw = read(TRIANGLE + NORMALS + f"f 1//1 2//{index} 3//1\n")
    assert np.isnan(raw.normals[1]).all()
    assert raw.warnings == [
        "1 corners name a normal that the file does not hold, the first on line 7: computed"
    ]


def test_normals_dropped_by_a_tool_leave_their_indices():
    raw = read(TRIANGLE + "f 1//7 2//8 3//9\n")
    assert raw.normals is None
    assert raw.warnings[0].startswith("3 corners name a normal")


def test_unused_vertices_stay_for_the_repair_to_count():
    raw = read("v 9 9 9\n" + TRIANGLE + "vt 0 0\nf 2/1 3/1 4/1\n")
    assert len(raw.positions) == 4
    assert sorted(raw.vertex_labels.tolist()) == [0, 1, 2, 3]


def test_short_faces_are_left_out_and_named():
    raw = read(TRIANGLE + "f 1 2\nf 1 2 3\nf 3\n")
    assert raw.n_short_faces == 2
    assert "line 4" in raw.warnings[0]


def test_colours_weights_and_unknown_lines_are_passed_over():
    text = "mtllib ../../etc/passwd\no é\nv 0 0 0 nan nan nan\nv 1 0 0 1\nv 0 1 0 # end\ns off\nf 1 2 3\nl 1 2"
    assert read(text).faces.tolist() == [[0, 1, 2]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("v 0 0\n", "line 1: 'v 0 0' cannot be read as a position: three numbers"),
        ("v 0 zero 0\n", "line 1: 'v 0 zero 0' cannot be read as a position"),
        (TRIANGLE + "f 1 2 4\n", "line 4: index 4 of a vertex points nowhere; the file has 3"),
        (TRIANGLE + "f 1 2 0\n", "line 4: index 0 or a relative one of a vertex points nowhere"),
        (TRIANGLE + "f -4 -2 -1\n", "line 4: index 0 or a relative one of a vertex points nowhere"),
        (TRIANGLE + "f 1 2 x\n", "line 4: 'f 1 2 x' cannot be read as a face"),
        (TRIANGLE + "vt\nf 1 2 3\n", "line 4: 'vt' cannot be read as a texture coordinate"),
        (TRIANGLE + "f 1.0 2 3\n", "line 4: 'f 1.0 2 3' cannot be read as a face"),
        (
            TRIANGLE + "vt 0 0\nf 1/1 2/2 3/1\n",
            "line 5: index 2 of a texture coordinate points nowhere",
        ),
        (TRIANGLE + "f 1/-1 2/-1 3/-1\n", "line 4: index 0 or a relative one of a texture"),
        (TRIANGLE + f"f 1 2 {10**30}\n", "line 4: 'f 1 2 1000"),
    ],
)
def test_refusals_name_the_line(text, message):
    with pytest.raises(MeshError) as refused:
        read(text)
    assert message in refused.value.detail


def test_limits():
    with pytest.raises(MeshError, match=r"line 5: a face with 4 corners; the limit is 3"):
        read(TRIANGLE + "v 1 1 0\nf 1 2 4 3\n", MeshLimits(polygon_corners=3))
    with pytest.raises(TooLarge, match="3 vertices; the limit is 2"):
        read(TRIANGLE, MeshLimits(vertices=2))
    with pytest.raises(TooLarge, match="2 triangles; the limit is 1"):
        read(TRIANGLE + "f 1 2 3\nf 3 2 1\n", MeshLimits(triangles=1))
