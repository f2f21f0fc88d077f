"""Loading from bytes: recognition, bounds, and that no other file is opened."""

import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prtbake_storage.errors import InputError, MeshError, PrtError, TooLarge
from prtbake_workers.geometry.loading import load_mesh, recognise_format
from prtbake_workers.geometry.raw_mesh import MeshLimits

STL_TEXT = b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\nendsolid x\n"
OFF = b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
PLY = (
    b"ply\nformat ascii 1.0\ncomment TextureFile secret.png\nelement vertex 3\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
)

PLY_WITH_NORMALS = (
    b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    b"property float nx\nproperty float ny\nproperty float nz\nproperty float s\nproperty float t\n"
    b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0 0 0 1 0 0\n1 0 0 0 0 1 1 0\n0 1 0 0 0 1 0 1\n3 0 1 2\n"
)


def test_cube_is_outward_and_closed(cube_obj):
    mesh, report = load_mesh(cube_obj, "obj")
    assert (mesh.n_vertices, mesh.n_faces, report.n_polygons) == (8, 12, 6)
    assert report.watertight
    assert report.flipped_faces == 0
    assert mesh.normals == pytest.approx((2 * mesh.positions - 1) / np.sqrt(3))
    assert report.extents == [1.0, 1.0, 1.0]


def test_creases_split_the_cube_within_the_limits(cube_obj):
    mesh, report = load_mesh(cube_obj, "obj", crease_angle_deg=30.0, limits=MeshLimits(vertices=24))
    assert (mesh.n_vertices, report.crease_vertices) == (24, 16)
    assert (np.sort(np.abs(mesh.normals), axis=1) == [0.0, 0.0, 1.0]).all()
    with pytest.raises(TooLarge, match="24 vertices; the limit is 23"):
        load_mesh(cube_obj, "obj", crease_angle_deg=30.0, limits=MeshLimits(vertices=23))


@pytest.mark.parametrize(
    ("data", "format"),
    [
        (b"# hi\nmtllib a.mtl\nv 0 0 0\n", "obj"),
        (PLY, "ply"),
        (STL_TEXT, "stl"),
        (bytes(80) + b"\1\0\0\0" + bytes(50), "stl"),
        (b"solid" + bytes(75) + b"\1\0\0\0" + bytes(50), "stl"),
        (b"# hi\n" + OFF, "off"),
        (b"glTF....", "glb"),
    ],
)
def test_formats_are_recognised(data, format):
    assert recognise_format(data) == format


def test_auto_equals_stated(cube_obj):
    for data, format in ((cube_obj, "obj"), (OFF, "off"), (PLY, "ply"), (STL_TEXT, "stl")):
        one, _ = load_mesh(data, "auto")
        two, report = load_mesh(data, format.upper())
        assert one.positions.tobytes() == two.positions.tobytes()
        assert one.faces.tobytes() == two.faces.tobytes()
        assert report.format == format


def test_unknown_content_and_format_are_refused(cube_obj):
    with pytest.raises(MeshError, match="none of OBJ"):
        load_mesh(b"\x89PNG\r\n\x1a\n", "auto")
    with pytest.raises(MeshError, match="is empty"):
        load_mesh(b"", "auto")
    with pytest.raises(MeshError, match="format 'fbx' is not one of"):
        load_mesh(cube_obj, "fbx")


def test_no_other_file_is_opened(cube_obj, pack_glb, triangle_gltf, tmp_path, monkeypatch):
    """Files named in the upload lie there, ready to be read; an audit hook sees every open."""
    monkeypatch.chdir(tmp_path)
    for name in ("secret.png", "secret.mtl", "secret.bin"):
        (tmp_path / name).write_bytes(b"newmtl x\nmap_Kd secret.png\n")
    header, binary = triangle_gltf
    header["images"] = [{"uri": "secret.png"}]
    header["textures"] = [{"source": 0}]
    header["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    header["meshes"][0]["primitives"][0]["material"] = 0
    uploads = [
        (b"mtllib secret.mtl\nusemtl x\n" + cube_obj, "obj"),
        (PLY, "ply"),
        (pack_glb(header, binary), "glb"),
    ]
    opened = []
    watching = True

    def hook(event, arguments):
        if watching and event == "open" and "secret" in str(arguments[0]):
            opened.append(arguments[0])

    sys.addaudithook(hook)
    for data, format in uploads:
        load_mesh(data, format)
    assert opened == []
    # the hook does see such an open
    (tmp_path / "secret.png").read_bytes()
    watching = False
    assert len(opened) == 1


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_cut_and_overwritten_files_never_raise_anything_else(data):
    """Whatever becomes of the bytes, the answer is a mesh or one of our own errors."""
    source, format = data.draw(
        st.sampled_from(
            [
                (OFF, "off"),
                (PLY, "ply"),
                (STL_TEXT, "stl"),
                (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "obj"),
                (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1\n", "obj"),
                (PLY_WITH_NORMALS, "ply"),
            ]
        )
    )
    raw = bytearray(source)
    for _ in range(data.draw(st.integers(0, 3))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    raw = raw[: data.draw(st.integers(0, len(raw)))]
    crease_angle_deg = data.draw(st.sampled_from([None, 30.0]))
    try:
        mesh, _ = load_mesh(bytes(raw), format, crease_angle_deg=crease_angle_deg)
    except PrtError:
        return
    assert np.isfinite(mesh.normals).all()


def test_errors_are_input_errors():
    assert issubclass(MeshError, InputError)
