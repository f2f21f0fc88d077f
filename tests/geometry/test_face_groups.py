"""Groups of faces: from the files that name them to the mesh, through every repair."""

import copy

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_workers.geometry.face_groups import (
    LONGEST_NAME,
    MOST_GROUPS,
    OTHERS,
    UNNAMED,
    distinct_names,
    settle_groups,
)
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import repair
from prtbake_workers.geometry.teapot import teapot

SQUARES = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 2 0 0\nv 2 1 0\n"


def groups_of(mesh):
    """Faces of each group, by name."""
    return {
        name: np.flatnonzero(mesh.face_groups == index).tolist()
        for index, name in enumerate(mesh.group_names)
    }


def load(text):
    return load_mesh(text.encode(), "obj")


def test_materials_of_an_obj_group_its_faces():
    mesh, report = load(
        SQUARES + "mtllib /etc/passwd\nusemtl red\nf 1 2 3 4\nusemtl blue\nf 2 5 6\n"
        "usemtl red\nf 2 6 3\n"
    )
    assert groups_of(mesh) == {"red": [0, 1, 3], "blue": [2]}
    assert report.groups == [{"name": "red", "faces": 3}, {"name": "blue", "faces": 1}]
    # a border of groups is no border of the surface: the vertices on it are shared
    assert mesh.n_vertices == 6
    assert report.components == 1


def test_faces_before_the_first_material_are_a_group_of_their_own():
    mesh, _ = load(SQUARES + "f 1 2 3\nusemtl\nf 1 3 4\nusemtl unnamed\nf 2 5 6\n")
    assert groups_of(mesh) == {UNNAMED: [0, 1], f"{UNNAMED} (2)": [2]}


def test_a_file_without_materials_has_no_groups():
    mesh, report = load(SQUARES + "g red\no blue\nf 1 2 3\n")
    assert mesh.face_groups is None
    assert mesh.group_names == ()
    assert report.groups == []


def test_dropped_turned_and_split_faces_keep_their_groups():
    """A cube of six groups, with flat, double and turned faces strewn in."""
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces, sides = [], []
    for side, (a, b, c, d) in enumerate(quads):
        # the second triangle turned over, then one without area and a double in a wrong group
        faces += [(a, b, c), (a, d, c), (a, a, b), (c, b, a)]
        sides += [side, side, (side + 1) % 6, (side + 2) % 6]
    raw = RawMesh(corners, np.array(faces), face_groups=np.array(sides), group_names="abcdef")
    for angle, n_vertices in ((None, 8), (30.0, 24)):
        mesh, report = repair(raw, "test", orient_outward=True, crease_angle_deg=angle)
        assert (report.degenerate_faces, report.duplicate_faces) == (6, 6)
        assert report.flipped_faces > 0
        assert mesh.n_vertices == n_vertices
        assert mesh.n_faces == len(mesh.face_groups) == 12
        middles = mesh.positions[mesh.faces].mean(axis=1) - 0.5
        for side, quad in enumerate(quads):
            outward = corners[list(quad)].mean(axis=0) - 0.5
            # a face of the side lies in the side's plane
            own = np.flatnonzero(np.isclose(middles @ outward, 0.25))
            assert groups_of(mesh)["abcdef"[side]] == own.tolist()


def test_groups_without_a_face_that_is_left_are_not_named():
    mesh, report = load(SQUARES + "usemtl flat\nf 1 2 2\nusemtl whole\nf 1 2 3\n")
    assert report.degenerate_faces == 1
    assert groups_of(mesh) == {"whole": [0]}


def test_the_teapot_has_four_groups():
    mesh = teapot(3)
    assert mesh.group_names == ("body", "lid", "handle", "spout")
    by_group = {
        name: mesh.positions[mesh.faces[faces]].reshape(-1, 3)
        for name, faces in groups_of(mesh).items()
    }
    # outlines of the patches: the lid's rim, and the sides that handle and spout stand on
    assert by_group["lid"][:, 1].min() == 2.4
    assert np.hypot(*by_group["lid"][:, [0, 2]].T).max() < 1.31
    assert by_group["handle"][:, 0].max() < -1.4
    assert by_group["spout"][:, 0].min() > 1.6
    assert by_group["body"][:, 1].min() == 0.0


def two_meshes(triangle_gltf, materials, *names):
    """Two meshes of two triangles each, of the materials given."""
    header, binary = copy.deepcopy(triangle_gltf)
    (primitive,) = header["meshes"][0]["primitives"]
    chosen = iter(materials)
    header["meshes"] = [
        {"primitives": [primitive | ({} if m is None else {"material": m}) for m in pair]}
        for pair in zip(chosen, chosen, strict=True)
    ]
    header["nodes"] = [
        {"mesh": 0, "translation": [0, 0, 1]},
        {"mesh": 1, "translation": [0, 0, 2], "name": "hung"},
    ]
    header["scenes"] = [{"nodes": [0, 1]}]
    header["materials"] = [{} if name is None else {"name": name} for name in names]
    return header, binary


@pytest.mark.parametrize(
    ("materials", "names", "groups"),
    [
        # by material where there are several
        ((0, 1, 1, 2), ("red", "blue", "red"), {"red": [1], "blue": [2, 6], "red (2)": [7]}),
        ((0, 1, 1, None), ("red", None), {"red": [1], "material 1": [2, 6], UNNAMED: [7]}),
        # by mesh, or the node it hangs on, where there is one
        ((0, 0, 0, None), ("red",), {"mesh 0": [1, 6], "hung": [2, 7]}),
        # what is no index stands for none, and one that points nowhere has no name
        (("0", [], -1, 7), ("red",), {UNNAMED: [1, 6], "material -1": [2], "material 7": [7]}),
    ],
)
def test_materials_or_meshes_group_the_faces_of_a_glb(
    pack_glb, triangle_gltf, materials, names, groups
):
    header, binary = two_meshes(triangle_gltf, materials, *names)
    # the triangles stand at heights of their own: 1 and 6 in the first mesh, 2 and 7 in the second
    positions = np.frombuffer(binary[:36], np.float32).reshape(3, 3)
    moved = (positions + np.array([[0, 0, 5]], np.float32)).tobytes()
    header["accessors"].append({**header["accessors"][0], "bufferView": 3})
    header["bufferViews"].append({"buffer": 0, "byteOffset": 68, "byteLength": 36})
    for mesh in header["meshes"]:
        second = mesh["primitives"][1]
        second["attributes"] = second["attributes"] | {"POSITION": 3}
    header["buffers"][0]["byteLength"] = 104
    mesh, report = load_mesh(pack_glb(header, binary + b"\0\0" + moved), "glb")
    assert mesh.n_faces == 4
    assert {group["name"]: group["faces"] for group in report.groups} == {
        name: len(heights) for name, heights in groups.items()
    }
    found = mesh.positions[mesh.faces[:, 0], 2]
    assert {n: sorted(found[faces]) for n, faces in groups_of(mesh).items()} == groups
    assert ("share a name" in " ".join(report.warnings)) == ("red (2)" in groups)


@pytest.mark.parametrize("name", [None, 7, [], "", "\0\x07"])
def test_a_mesh_of_no_usable_name_still_makes_a_group(pack_glb, triangle_gltf, name):
    header, binary = triangle_gltf
    header["meshes"][0]["name"] = name
    mesh, _ = load_mesh(pack_glb(header, binary), "glb")
    assert mesh.group_names == ((UNNAMED if name == "\0\x07" else "mesh 0"),)


def test_names_that_fit_no_message_are_cut_and_kept_apart():
    long = "x" * 500
    text = SQUARES + (
        f"usemtl {long}a\nf 1 2 3\nusemtl {long}b\nf 1 3 4\nusemtl Ångström à la\x07 carte\nf 2 5 6\n"
    )
    mesh, report = load(text)
    one, two, odd = mesh.group_names
    assert one == "x" * LONGEST_NAME
    assert two == "x" * (LONGEST_NAME - 4) + " (2)"
    assert odd == "Ångström à la carte"
    assert "2 groups of faces have a name of more than 100 characters" in " ".join(report.warnings)
    # no byte of a name reaches further than a name
    assert max(map(len, report.warnings)) < 300


def test_a_number_sign_belongs_to_the_name():
    """3ds Max calls materials so; cut at the sign both would be one group."""
    mesh, _ = load(SQUARES + "usemtl Material#1\nf 1 2 3 # a face\nusemtl Material#2\nf 1 3 4\n")
    assert mesh.group_names == ("Material#1", "Material#2")


def test_groups_beyond_the_limit_are_one():
    settled = settle_groups([str(i) for i in range(1000)], np.arange(1000))
    assert len(settled.names) == MOST_GROUPS
    assert settled.names[-1] == OTHERS
    assert (settled.of_face[: MOST_GROUPS - 1] == np.arange(MOST_GROUPS - 1)).all()
    assert (settled.of_face[MOST_GROUPS - 1 :] == MOST_GROUPS - 1).all()
    assert settled.warnings == ["the faces are in 1000 groups; those after the first 255 are one"]


@given(st.lists(st.text(max_size=150), min_size=1, max_size=40), st.data())
def test_settled_names_are_legal_whatever_the_file_says(names, data):
    faces = data.draw(st.lists(st.integers(0, len(names) - 1), min_size=1, max_size=60))
    settled = settle_groups(names, np.array(faces))
    assert len(set(settled.names)) == len(settled.names) == len(set(faces))
    for name in settled.names:
        assert 1 <= len(name) <= LONGEST_NAME
        assert name.isprintable()
        assert name == name.strip()
    # faces that were together stay so, and no others join them
    together = {(old, new) for old, new in zip(faces, settled.of_face.tolist(), strict=True)}
    assert len(together) == len(set(faces))


def test_numbered_names_do_not_run_into_those_that_are_there():
    assert distinct_names(["a", "a", "a (2)", "a"]) == ["a", "a (3)", "a (2)", "a (4)"]
    assert distinct_names(["object", "b"], taken=["object"]) == ["object (2)", "b"]
