"""PLY, STL, OFF and GLB: sound files are read, broken ones refused with a place."""

import struct

import numpy as np
import pytest

from prtbake_storage.errors import MeshError, TooLarge
from prtbake_workers.geometry.foreign_readers import read_foreign
from prtbake_workers.geometry.raw_mesh import MeshLimits

LIMITS = MeshLimits()
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
PLY_HEADER = (
    "ply\nformat {kind} 1.0\nelement vertex {n}\nproperty float x\nproperty float y\n"
    "property float z\nelement face {m}\nproperty list uchar int vertex_indices\nend_header\n"
)


def text_ply(vertices="0 0 0\n1 0 0\n0 1 0\n", faces="3 0 1 2\n", n=3, m=1):
    return (PLY_HEADER.format(kind="ascii", n=n, m=m) + vertices + faces).encode()


def binary_stl(triangles):
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *np.ravel(triangle), 0) for triangle in triangles)
    return bytes(80) + struct.pack("<I", len(triangles)) + body


def same_triangle(raw):
    return raw.positions[raw.faces].tolist() == [CORNERS.tolist()]


def test_formats_agree_on_one_triangle():
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    packed = CORNERS.tobytes() + struct.pack("<B3i", 3, 0, 1, 2)
    for data, format in (
        (text_ply(), "ply"),
        (PLY_HEADER.format(kind="binary_little_endian", n=3, m=1).encode() + packed, "ply"),
        (binary_stl([CORNERS]), "stl"),
        (f"solid x\n{facet}endsolid x\n".encode(), "stl"),
        (b"OFF\n# a comment\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "off"),
        (b"OFF 3 1 0\n0 0 0\n1 0 0\n\n0 1 0\n3 0 1 2\n", "off"),
    ):
        raw = read_foreign(data, format, LIMITS)
        assert same_triangle(raw), (format, data[:20])
        assert raw.uv is None


def test_ply_texture_coordinates_are_kept():
    header = PLY_HEADER.replace(
        "property float z\n", "property float z\nproperty float s\nproperty float t\n"
    )
    data = header.format(kind="ascii", n=3, m=1) + "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 0.25\n3 0 1 2\n"
    raw = read_foreign(data.encode(), "ply", LIMITS)
    assert raw.uv[raw.faces[0]].tolist() == [[0, 0], [1, 0], [0, 0.25]]


def with_normals(header, binary, normals, *, component=5126, **view):
    """Give the triangle of `triangle_gltf` normals, packed as they come."""
    packed = np.ascontiguousarray(normals).tobytes()
    binary += b"\0" * (-len(binary) % 4)
    header["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = len(header["accessors"])
    header["accessors"].append(
        {"bufferView": 3, "componentType": component, "count": 3, "type": "VEC3"}
    )
    header["bufferViews"].append(
        {"buffer": 0, "byteOffset": len(binary), "byteLength": len(packed), **view}
    )
    header["buffers"][0]["byteLength"] = len(binary) + len(packed)
    return header, binary + packed


LEANING = np.array([[0, 0, 1], [0, 0.6, 0.8], [0.6, 0, 0.8]], np.float32)


def test_glb_normals_are_read(pack_glb, triangle_gltf):
    raw = read_foreign(pack_glb(*triangle_gltf), "glb", LIMITS)
    assert raw.normals is None
    raw = read_foreign(pack_glb(*with_normals(*triangle_gltf, LEANING)), "glb", LIMITS)
    assert raw.normals.tolist() == LEANING.astype(np.float64).tolist()


@pytest.mark.parametrize(
    ("component", "dtype", "columns", "view"),
    [(5120, np.int8, 4, {"byteStride": 4}), (5122, np.int16, 4, {"byteStride": 8}),
     (5122, np.int16, 3, {})],
)  # fmt: skip
def test_glb_normals_in_whole_numbers_have_the_same_direction(
    pack_glb, triangle_gltf, component, dtype, columns, view
):
    whole = np.zeros((3, columns), dtype)
    whole[:, :3] = np.round(LEANING * np.iinfo(dtype).max)
    header, binary = with_normals(*triangle_gltf, whole, component=component, **view)
    raw = read_foreign(pack_glb(header, binary), "glb", LIMITS)
    units = raw.normals / np.linalg.norm(raw.normals, axis=1, keepdims=True)
    assert units == pytest.approx(LEANING, abs=0.6 / np.iinfo(dtype).max)


@pytest.mark.parametrize(
    "linear",
    [np.diag([2.0, 1.0, 1.0]), np.diag([-1.0, 1.0, 1.0]), np.diag([1e9, 1e9, 1e9]),
     np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.25], [0.0, 0.0, 3.0]]), -np.eye(3)],
    ids=["stretched", "mirrored", "large", "sheared", "inverted"],
)  # fmt: skip
def test_glb_normals_stay_perpendicular_under_a_transform(pack_glb, triangle_gltf, linear):
    """A plane's normal is perpendicular to it before and after, and on its outside."""
    header, binary = with_normals(*triangle_gltf, np.tile(np.float32([0, 0, 1]), (3, 1)))
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    header["nodes"] = [{"mesh": 0, "matrix": matrix.T.ravel().tolist()}]
    raw = read_foreign(pack_glb(header, binary), "glb", LIMITS)
    a, b, c = raw.positions[raw.faces[0]]
    normal = np.cross(b - a, c - a)
    given = raw.normals[0] / np.linalg.norm(raw.normals[0])
    assert given == pytest.approx(normal / np.linalg.norm(normal), abs=1e-7)


def test_glb_transforms_of_normals_are_not_those_of_points(pack_glb, triangle_gltf):
    """The negative twin: a leaning normal under a stretch turns the other way."""
    header, binary = with_normals(*triangle_gltf, np.tile(np.float32([0.6, 0, 0.8]), (3, 1)))
    header["nodes"] = [{"mesh": 0, "scale": [4, 1, 1]}]
    normal = read_foreign(pack_glb(header, binary), "glb", LIMITS).normals[0]
    assert normal[0] / normal[2] == pytest.approx(0.6 / 0.8 / 4.0, rel=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_normals_that_are_not_finite_become_zero(pack_glb, triangle_gltf, bad):
    normals = LEANING.copy()
    normals[1, 2] = bad
    raw = read_foreign(pack_glb(*with_normals(*triangle_gltf, normals)), "glb", LIMITS)
    assert raw.normals[1].tolist() == [0, 0, 0]
    assert raw.normals[0].tolist() == [0, 0, 1]


def test_parts_without_normals_get_nan(pack_glb, triangle_gltf):
    header, binary = with_normals(*triangle_gltf, LEANING)
    header["meshes"].append({"primitives": [{"attributes": {"POSITION": 0}, "indices": 2}]})
    header["nodes"] = [{"mesh": 0}, {"mesh": 1, "translation": [0, 0, 5]}]
    header["scenes"][0]["nodes"] = [0, 1]
    raw = read_foreign(pack_glb(header, binary), "glb", LIMITS)
    assert np.isnan(raw.normals).all(axis=1).tolist() == (raw.positions[:, 2] == 5.0).tolist()
    assert np.isnan(raw.normals).sum() == 9


def test_stl_normals_of_facets_are_not_normals_of_vertices():
    facet = "facet normal 0 1 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    assert read_foreign(f"solid x\n{facet}endsolid x\n".encode(), "stl", LIMITS).normals is None


def test_glb_texture_coordinates_count_from_below(pack_glb, triangle_gltf):
    raw = read_foreign(pack_glb(*triangle_gltf), "glb", LIMITS)
    assert same_triangle(raw)
    assert raw.uv[raw.faces[0]].tolist() == [[0, 1], [1, 1], [0, 0.75]]


def test_glb_transforms_apply_down_the_tree(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    half = np.sqrt(0.5)
    header["nodes"] = [
        {"children": [1], "translation": [10, 0, 0]},
        # a quarter turn about z, then twice the size
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 2, 2]},
    ]
    raw = read_foreign(pack_glb(header, binary), "glb", LIMITS)
    expected = [[10, 0, 0], [10, 2, 0], [8, 0, 0]]
    assert raw.positions[raw.faces[0]] == pytest.approx(np.array(expected), abs=1e-12)


def test_glb_mirrored_parts_keep_their_outside(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header["nodes"] = [{"mesh": 0, "scale": [-1, 1, 1]}]
    raw = read_foreign(pack_glb(header, binary), "glb", LIMITS)
    a, b, c = raw.positions[raw.faces[0]]
    assert np.cross(b - a, c - a)[2] > 0.0


def test_glb_instances_become_copies_in_file_order(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header["nodes"] = [{"mesh": 0, "translation": [0, 0, k]} for k in range(5)]
    header["scenes"][0]["nodes"] = list(range(5))
    packed = pack_glb(header, binary)
    raw = read_foreign(packed, "glb", LIMITS)
    assert len(raw.faces) == 5
    again = read_foreign(packed, "glb", LIMITS)
    assert raw.positions.tobytes() == again.positions.tobytes()


def test_glb_strips_are_read(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header["meshes"][0]["primitives"][0]["mode"] = 5
    assert same_triangle(read_foreign(pack_glb(header, binary), "glb", LIMITS))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_positions_that_are_not_finite_pass_to_the_repair_as_they_are(pack_glb, triangle_gltf, bad):
    header, binary = triangle_gltf
    header["nodes"] = [{"mesh": 0, "translation": [0, 0, 5]}]
    values = np.frombuffer(binary[:36], np.float32).copy()
    values[4] = bad
    raw = read_foreign(pack_glb(header, values.tobytes() + binary[36:]), "glb", LIMITS)
    assert raw.positions[1].tolist()[::2] == [1, 0]


OFF = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("data", "format", "message"),
    [
        (b"", "ply", "no header"),
        (b"ply\nformat ascii 1.0\n" + bytes(100_000), "ply", "one that does not end"),
        (text_ply(n=3_000_000), "ply", "line 3: 3000000 elements 'vertex' in a file of"),
        (text_ply(n=4), "ply", "promises 5 lines, but 4 follow"),
        (text_ply(faces="4 0 1 2\n"), "ply", "line 13: '4 0 1 2' is not a face"),
        (text_ply(faces="\n3 0 1 2\n"), "ply", "line 13: '' is not a face"),
        (text_ply(faces="3 0 1 7\n"), "ply", "triangle 0 .* 3 vertices"),
        (text_ply(faces="3 0 1 -1\n"), "ply", "triangle 0 .* 3 vertices"),
        (text_ply(vertices="0 0 0\n1 zero 0\n0 1 0\n"), "ply", "PLY"),
        (b"ply\nformat ascii 1.0\n\nend_header\n", "ply", "line 3 of the header is empty"),
        (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", "ply", "line 3"),
        (b"ply\nformat ascii 1.0\nelement edge 2\nend_header\n", "ply", "'edge' are not read"),
        (
            PLY_HEADER.format(kind="binary_little_endian", n=3, m=3).encode()
            + CORNERS.tobytes()
            # 4 + 3 + 5 corners take the room of 4 + 4 + 4
            + struct.pack("<B4i", 4, 0, 1, 2, 0)
            + struct.pack("<B3i", 3, 0, 1, 2)
            + struct.pack("<B5i", 5, 0, 1, 2, 0, 1),
            "ply",
            "face 1 has 3 corners and face 0 has 4",
        ),
        (bytes(100), "stl", "promises 0 triangles"),
        (binary_stl([CORNERS])[:-1], "stl", "promises 1 triangles"),
        (b"solid x\nfacet", "stl", "neither a binary file nor text"),
        (b"solid x\nvertex 0 0 0\nvertex 1 zero 0\nvertex 0 0 1\nendsolid", "stl", "STL"),
        (b"NOFF\n", "off", "does not begin"),
        (b"OFF\n", "off", "does not give the counts"),
        (b"OFF\nthree 1 0\n", "off", "line 2: 'three 1 0' does not give"),
        (b"OFF\n3 9 0\n0 0 0\n", "off", "line 2 promises 3 vertices and 9 faces, but 1 lines"),
        ((OFF + "3 0 1 3\n").encode(), "off", "line 6: corner 3 points nowhere"),
        ((OFF + "3 0 1 -1\n").encode(), "off", "line 6: corner -1 points nowhere"),
        ((OFF + "3 0 1\n").encode(), "off", "line 6: '3 0 1' is not a face"),
        ((OFF + "x 0 1\n").encode(), "off", "line 6"),
        (b"OFF\n3 1 0\n0 0 0\n1 0\n0 1 0\n3 0 1 2\n", "off", "line 4: '1 0' is not a position"),
        (b"OFF\n3 1 0\n0 0 0\n1 0 z\n0 1 0\n3 0 1 2\n", "off", "OFF"),
        (f"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n300 {'0 ' * 300}\n".encode(), "off", "line 6: a face with 300"),
    ],
)  # fmt: skip
def test_broken_files_are_refused(data, format, message):
    with pytest.raises(MeshError, match=message):
        read_foreign(data, format, LIMITS)


@pytest.mark.parametrize(
    ("data", "format"),
    [(text_ply(), "ply"), (binary_stl([CORNERS]), "stl"), (OFF.encode() + b"3 0 1 2\n", "off")],
)
def test_limits_hold_for_all(data, format):
    with pytest.raises(TooLarge, match="3 vertices; the limit is 2"):
        read_foreign(data, format, MeshLimits(vertices=2))
    with pytest.raises(TooLarge, match="1 triangles; the limit is 0"):
        read_foreign(data, format, MeshLimits(triangles=0))


@pytest.mark.parametrize(("n", "m"), [(0, 0), (3, 0)])
def test_points_alone_give_no_faces(n, m):
    raw = read_foreign(text_ply(faces="", vertices="0 0 0\n" * n, n=n, m=m), "ply", LIMITS)
    assert raw.faces.shape == (0, 3)
    assert len(raw.positions) == n
