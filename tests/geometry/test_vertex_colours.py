"""Vertex colours: every format gives the same linear values, broken ones are left out and named."""

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prtbake_storage.errors import MeshError
from prtbake_workers.geometry.loading import load_mesh

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
CODES = np.array([[255, 0, 51], [10, 128, 200], [1, 2, 3]])
FRACTIONS = np.array([[0.5, 0.25, 0.125], [1.0, 0.0, 0.75], [0.0625, 0.375, 0.875]])
# the stored float32 rounds by 6e-8 of the value
ROUNDED = 1e-7


def decoded(code):
    """IEC 61966-2-1 for one number in [0, 1]: the oracle, in plain floats."""
    return code / 12.92 if code <= 0.04045 else ((code + 0.055) / 1.055) ** 2.4


def linear(codes):
    return np.vectorize(decoded)(np.asarray(codes, float))


def ply(colours, *, kind="uchar", names=("red", "green", "blue"), binary=None, faces=None):
    properties = "".join(f"property {kind} {name}\n" for name in names)
    encoding = "ascii" if binary is None else "binary_little_endian"
    header = (
        f"ply\nformat {encoding} 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        f"property float z\n{properties}element face 1\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    if binary is not None:
        rows = b"".join(
            place.tobytes() + np.asarray(colour, binary).tobytes()
            for place, colour in zip(CORNERS, colours, strict=True)
        )
        return header + rows + struct.pack("<B3i", 3, 0, 1, 2)
    lines = (
        " ".join(f"{x!s}" for x in (*place, *colour))
        for place, colour in zip(CORNERS, colours, strict=True)
    )
    return header + ("\n".join(lines) + "\n3 0 1 2\n").encode()


def obj(colours):
    lines = (
        "v " + " ".join(str(x) for x in (*place, *colour))
        for place, colour in zip(CORNERS, colours, strict=True)
    )
    return ("\n".join(lines) + "\nf 1 2 3\n").encode()


def off(colours, keyword="COFF"):
    lines = (
        " ".join(str(x) for x in (*place, *colour))
        for place, colour in zip(CORNERS, colours, strict=True)
    )
    return (f"{keyword}\n3 1 0\n" + "\n".join(lines) + "\n3 0 1 2\n").encode()


def with_colours(triangle, colours, *, component, kind="VEC3", **view):
    """Give the triangle of `triangle_gltf` colours, packed as they come."""
    header, binary = triangle
    packed = np.ascontiguousarray(colours).tobytes()
    binary += b"\0" * (-len(binary) % 4)
    header["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = len(header["accessors"])
    header["accessors"].append(
        {"bufferView": 3, "componentType": component, "count": 3, "type": kind,
         "normalized": component != 5126}
    )  # fmt: skip
    header["bufferViews"].append(
        {"buffer": 0, "byteOffset": len(binary), "byteLength": len(packed), **view}
    )
    header["buffers"][0]["byteLength"] = len(binary) + len(packed)
    return header, binary + packed


def colours_of(data, format):
    """Load, and give the colours in the order of `CORNERS`, with the report."""
    mesh, report = load_mesh(data, format)
    if mesh.colours is None:
        assert not report.vertex_colours
        return None, report
    assert report.vertex_colours
    assert mesh.colours.dtype == np.float32
    order = [int(np.flatnonzero((mesh.positions == corner).all(axis=1))[0]) for corner in CORNERS]
    return mesh.colours[order], report


@pytest.mark.parametrize(
    ("data", "format"),
    [
        (ply(CODES), "ply"),
        (ply(CODES, kind="uint8"), "ply"),
        (ply(CODES, binary=np.uint8), "ply"),
        (ply(CODES * 257, kind="ushort"), "ply"),
        (ply(CODES * 257, kind="ushort", binary="<u2"), "ply"),
        (ply(CODES.astype(float)), "ply"),
        (ply(CODES, names=("diffuse_red", "diffuse_green", "diffuse_blue")), "ply"),
        (ply(np.hstack([CODES, [[7]] * 3]), names=("red", "green", "blue", "alpha")), "ply"),
        (obj(CODES / 255), "obj"),
        (obj(np.hstack([CODES / 255, [[0.5]] * 3])), "obj"),
        (off(CODES), "off"),
        (off(np.hstack([CODES, [[255]] * 3])), "off"),
    ],
)
def test_codes_are_made_linear(data, format):
    colours, report = colours_of(data, format)
    assert report.colour_encoding == "srgb"
    assert colours == pytest.approx(linear(CODES / 255), rel=ROUNDED)
    # the negative twin: the codes themselves are far from it
    assert np.abs(colours - CODES / 255).max() > 0.2


@pytest.mark.parametrize(
    ("data", "format"),
    [
        (ply(FRACTIONS, kind="float"), "ply"),
        (ply(FRACTIONS, kind="double"), "ply"),
        (ply(FRACTIONS, kind="float", binary="<f4"), "ply"),
        (off(FRACTIONS), "off"),
        (off(np.hstack([FRACTIONS, [[1.0]] * 3])), "off"),
    ],
)
def test_fractions_are_linear_except_in_obj(data, format):
    colours, report = colours_of(data, format)
    assert report.colour_encoding == "linear"
    assert colours.tolist() == FRACTIONS.tolist()
    colours, report = colours_of(obj(FRACTIONS), "obj")
    assert report.colour_encoding == "srgb"
    assert colours == pytest.approx(linear(FRACTIONS), rel=ROUNDED)


def test_zeros_and_ones_of_a_coff_are_no_bytes():
    colours, _ = colours_of(off([[1, 0, 0], [0, 1, 0], [1, 1, 1]]), "off")
    assert colours.tolist() == [[1, 0, 0], [0, 1, 0], [1, 1, 1]]


@pytest.mark.parametrize("columns", [3, 4])
@pytest.mark.parametrize(
    ("component", "dtype", "view"),
    [(5121, np.uint8, {"byteStride": 4}), (5123, np.uint16, {"byteStride": 8}),
     (5126, np.float32, {})],
)  # fmt: skip
def test_glb_colours_are_linear_in_all_types(
    pack_glb, triangle_gltf, columns, component, dtype, view
):
    width = 4 if view else columns
    rows = np.full((3, width), 99.0)
    rows[:, :3] = FRACTIONS
    largest = 1.0 if dtype is np.float32 else float(np.iinfo(dtype).max)
    rows[:, :3] = np.round(rows[:, :3] * largest) if view else rows[:, :3]
    kind = f"VEC{columns}"
    packed = with_colours(triangle_gltf, rows.astype(dtype), component=component, kind=kind, **view)
    colours, report = colours_of(pack_glb(*packed), "glb")
    assert report.colour_encoding == "linear"
    assert colours == pytest.approx(FRACTIONS, abs=0.51 / largest if view else 0.0)


def test_glb_clamps_what_the_format_lets_be_clamped(pack_glb, triangle_gltf):
    beyond = FRACTIONS.copy()
    beyond[1] = [1.5, -0.25, 0.75]
    packed = with_colours(triangle_gltf, beyond.astype(np.float32), component=5126)
    colours, report = colours_of(pack_glb(*packed), "glb")
    assert colours[1].tolist() == [1.0, 0.0, 0.75]
    assert report.clamped_colours == 1
    assert "1 vertices have a colour outside [0, 1]: clamped" in report.warnings


def test_glb_parts_without_colours_are_white(pack_glb, triangle_gltf):
    header, binary = with_colours(triangle_gltf, FRACTIONS.astype(np.float32), component=5126)
    bare = {"attributes": {"POSITION": 0}, "indices": 2}
    header["meshes"].append({"primitives": [bare]})
    header["nodes"].append({"mesh": 1, "translation": [5, 0, 0]})
    header["scenes"] = [{"nodes": [0, 1]}]
    mesh, report = load_mesh(pack_glb(header, binary), "glb")
    far = mesh.positions[:, 0] > 4
    assert (mesh.colours[far] == 1).all()
    assert report.vertices_without_colour == 3 == np.count_nonzero(far)
    assert "3 vertices have no colour in the file: white" in report.warnings


@pytest.mark.parametrize("change", [{"sparse": {}}, {"type": "VEC2"}, {"componentType": 5122}])
def test_glb_colours_that_cannot_be_read_leave_the_mesh(pack_glb, triangle_gltf, change):
    header, binary = with_colours(triangle_gltf, FRACTIONS.astype(np.float32), component=5126)
    header["accessors"][-1] |= change
    colours, report = colours_of(pack_glb(header, binary), "glb")
    assert colours is None
    assert "COLOR_0 is packed in a way that is not read: left out" in report.warnings[0]


def test_glb_colours_beyond_the_file_are_refused(pack_glb, triangle_gltf):
    header, binary = with_colours(triangle_gltf, FRACTIONS.astype(np.float32), component=5126)
    header["accessors"][-1]["count"] = 10**9
    with pytest.raises(MeshError, match=r"COLOR_0.*reach beyond"):
        load_mesh(pack_glb(header, binary), "glb")


@pytest.mark.parametrize("broken", ["nan", "inf", "1.01", "-0.01", "255"])
@pytest.mark.parametrize(("pack", "format"), [(obj, "obj"), (off, "off"), (ply, "ply")])
def test_broken_colours_are_left_out_and_the_vertex_named(pack, format, broken):
    rows = [[str(x) for x in row] for row in FRACTIONS]
    rows[1][2] = broken
    data = pack(rows, kind="float") if pack is ply else pack(rows)
    colours, report = colours_of(data, format)
    assert colours is None
    assert report.colour_encoding is None
    (warning,) = (text for text in report.warnings if "colours" in text)
    assert "vertex 1 (counted from 0)" in warning
    assert f"{float(broken):g})" in warning


def test_words_for_numbers_are_left_out_too():
    rows = [[str(x) for x in row] for row in FRACTIONS]
    rows[2][0] = "red"
    for data, format in ((obj(rows), "obj"), (off(rows), "off")):
        colours, report = colours_of(data, format)
        assert colours is None
        assert any("vertex 2 (counted from 0)" in text for text in report.warnings)


@pytest.mark.parametrize("broken", ["256", "-1", "0.5", "nan", "1e999"])
def test_text_ply_codes_that_would_wrap_are_refused(broken):
    rows = [[str(x) for x in row] for row in CODES]
    rows[1][2] = broken
    with pytest.raises(MeshError, match=rf"the colour '{broken}' of vertex 1 .* is no uchar"):
        load_mesh(ply(rows), "ply")


@pytest.mark.parametrize("kind", ["int", "char"])
def test_ply_types_that_mean_nothing_are_left_out(kind):
    colours, report = colours_of(ply(CODES // 3, kind=kind), "ply")
    assert colours is None
    assert "not all uchar, ushort, float or double" in report.warnings[0]


def test_ply_colours_of_several_types_are_left_out():
    data = ply(CODES).replace(b"property uchar green", b"property float green")
    colours, report = colours_of(data, "ply")
    assert colours is None
    assert "not all uchar" in report.warnings[0]


def test_rounding_of_text_is_forgiven_and_no_more():
    colours, _ = colours_of(obj([[1.0000005, 0, 0], [0, -0.0000005, 0], [0, 0, 1]]), "obj")
    assert colours.tolist() == [[1, 0, 0], [0, 0, 0], [0, 0, 1]]
    assert colours_of(obj([[1.00001, 0, 0], [0, 0, 0], [0, 0, 1]]), "obj")[0] is None


def test_a_colour_of_an_unused_vertex_does_no_harm():
    data = b"v 9 9 9 nan nan nan\n" + obj(CODES / 255).replace(b"f 1 2 3", b"f 2 3 4")
    colours, _ = colours_of(data, "obj")
    assert colours == pytest.approx(linear(CODES / 255), rel=ROUNDED)


def test_vertices_without_colour_are_white():
    for data, format in (
        (b"v 0 0 0 0 0 0\nv 1 0 0\nv 0 1 0 1.5\nf 1 2 3\n", "obj"),
        (b"COFF\n3 1 0\n0 0 0 0 0 0 1\n1 0 0\n0 1 0 0.5\n3 0 1 2\n", "off"),
    ):
        colours, report = colours_of(data, format)
        assert colours.tolist() == [[0, 0, 0], [1, 1, 1], [1, 1, 1]]
        assert report.vertices_without_colour == 2


def test_numbers_behind_the_positions_of_a_plain_off_are_no_colours():
    colours, report = colours_of(off(FRACTIONS, keyword="OFF"), "off")
    assert colours is None
    assert report.warnings == []


def test_colours_follow_vertices_that_a_texture_splits():
    """trimesh splits and reorders the vertices of such a file."""
    text = (
        "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        "property float z\nproperty float s\nproperty float t\nproperty uchar red\n"
        "property uchar green\nproperty uchar blue\nelement face 2\n"
        "property list uchar int vertex_indices\nend_header\n"
        "0 0 0 1 0 10 0 0\n1 0 0 0 0 20 0 0\n1 1 0 0 1 30 0 0\n0 1 0 1 1 40 0 0\n"
        "3 2 3 0\n3 0 1 2\n"
    )
    mesh, _ = load_mesh(text.encode(), "ply")
    codes = 10 + 10 * np.array([0, 1, 3, 2])
    expected = {(int(x), int(y)): codes[int(x) + 2 * int(y)] for x, y, _ in mesh.positions}
    for position, colour in zip(mesh.positions, mesh.colours, strict=True):
        code = expected[int(position[0]), int(position[1])]
        assert colour[0] == pytest.approx(decoded(code / 255), rel=ROUNDED)


SOUP = (
    "v 0 0 0 {a}\nv 1 0 0 {a}\nv 0 1 0 {a}\nv 1 0 0 {b}\nv 1 1 0 {b}\nv 0 1 0 {b}\n"
    "f 1 2 3\nf 4 5 6\n"
)


def test_vertices_of_different_colours_are_not_merged():
    mesh, report = load_mesh(SOUP.format(a="1 0 0", b="0 1 0").encode(), "obj")
    assert (mesh.n_vertices, report.duplicate_vertices, report.colour_split_vertices) == (6, 0, 2)
    assert report.uv_seam_vertices == report.normal_split_vertices == 0
    # the two halves are one flat sheet all the same: one component, one normal
    assert report.components == 1
    assert mesh.normals == pytest.approx(np.tile([0, 0, 1.0], (6, 1)))
    assert (mesh.colours[mesh.faces[0]] == [1, 0, 0]).all()
    assert (mesh.colours[mesh.faces[1]] == [0, 1, 0]).all()
    same, report = load_mesh(SOUP.format(a="1 0 0", b="1 0 0").encode(), "obj")
    assert (same.n_vertices, report.duplicate_vertices, report.colour_split_vertices) == (4, 2, 0)
    # colours that are left out do not split either
    broken, report = load_mesh(SOUP.format(a="1 0 0", b="2 0 0").encode(), "obj")
    assert (broken.n_vertices, report.duplicate_vertices) == (4, 2)


def test_creases_split_vertices_and_both_keep_the_colour():
    rows = "".join(f"v {x} {y} {z} {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1))
    faces = "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
    mesh, report = load_mesh((rows + faces).encode(), "obj", crease_angle_deg=30.0)
    assert (mesh.n_vertices, report.crease_vertices) == (24, 16)
    # 0 and 1 are themselves in both encodings
    assert (mesh.colours == mesh.positions).all()


@settings(deadline=None, max_examples=15)
@given(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=3, max_size=3))
def test_all_formats_give_the_same_colours(codes):
    codes = np.array(codes)
    texts = [(ply(codes), "ply"), (ply(codes, binary=np.uint8), "ply"), (obj(codes / 255), "obj")]
    if codes.max() > 1:
        texts.append((off(codes), "off"))
    for data, format in texts:
        colours, _ = colours_of(data, format)
        assert colours == pytest.approx(linear(codes / 255), rel=ROUNDED)
