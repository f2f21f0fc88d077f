"""Registration of meshes as the job does it: options in, canonical file and report out."""

import numpy as np
import pytest
from pydantic import ValidationError

from prtbake_storage.hdf5.resources import read_mesh
from support.local_stages import registered

CUBE = b"""\
v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nv 1 0 1\nv 1 1 1\nv 0 1 1
f 4 3 2 1\nf 5 6 7 8\nf 1 2 6 5\nf 2 3 7 6\nf 3 4 8 7\nf 4 1 5 8
"""
NORMALS = b"vn 0 0 -1\nvn 0 0 1\nvn 0 -1 0\nvn 1 0 0\nvn 0 1 0\nvn -1 0 0\n"
WITH_NORMALS = (
    NORMALS
    + CUBE[: CUBE.index(b"f")]
    + b"".join(
        b"f " + b" ".join(corner + b"//%d" % side for corner in line.split()[1:]) + b"\n"
        for side, line in enumerate(CUBE[CUBE.index(b"f") :].splitlines(), start=1)
    )
)


def mesh_of(store, data=None, **options):
    found = registered(
        store, "mesh", **({} if data is None else {"blob": store.put_bytes(data)}), **options
    )
    return read_mesh(store.local_path(found["canonical"])), found["understood"]


@pytest.mark.parametrize(
    ("data", "options", "n_vertices", "counts"),
    [
        (CUBE, {}, 8, {"has_normals": False, "crease_vertices": 0}),
        (CUBE, {"crease_angle_deg": 30.0}, 24, {"crease_vertices": 16, "crease_edges": 12}),
        (CUBE, {"crease_angle_deg": 120.0}, 8, {"crease_vertices": 0}),
        (WITH_NORMALS, {}, 24, {"has_normals": True, "normal_split_vertices": 16}),
        (WITH_NORMALS, {"crease_angle_deg": 120.0}, 8, {"has_normals": False}),
    ],
)
def test_normals_are_those_asked_for(store, data, options, n_vertices, counts):
    mesh, understood = mesh_of(store, data, **options)
    assert len(mesh.positions) == understood["n_vertices"] == n_vertices
    assert {name: understood[name] for name in counts} == counts
    assert understood["watertight"]
    flat = n_vertices == 24
    assert (np.abs(mesh.normals).max(axis=1) == 1.0).all() == flat
    assert mesh.report == understood


def test_a_built_in_keeps_its_exact_normals_unless_creases_are_asked_for(store):
    builtin = {"name": "icosphere", "tessellation": 1}
    exact, understood = mesh_of(store, builtin=builtin)
    assert (understood["n_vertices"], understood["crease_vertices"]) == (42, 0)
    assert exact.normals == pytest.approx(exact.positions - [0.0, 1.0, 0.0], abs=1e-15)
    faceted, understood = mesh_of(store, builtin=builtin, crease_angle_deg=5.0)
    assert understood["n_vertices"] == len(faceted.positions) == 240
    assert understood["crease_vertices"] == 240 - 42


def test_groups_of_faces_are_stored_and_told(store):
    data = CUBE.replace(b"f 4 3", b"usemtl white\nf 4 3").replace(b"f 2 3", b"usemtl red\nf 2 3")
    for options, n_vertices in (({}, 8), ({"crease_angle_deg": 30.0}, 24)):
        mesh, understood = mesh_of(store, data, **options)
        assert len(mesh.positions) == n_vertices
        assert mesh.group_names == ("white", "red")
        assert mesh.face_groups.tolist() == [0] * 6 + [1] * 6
        assert understood["groups"] == [
            {"name": "white", "faces": 6},
            {"name": "red", "faces": 6},
        ]
    for crease in (None, 30.0):
        mesh, understood = mesh_of(
            store, builtin={"name": "teapot", "tessellation": 2}, crease_angle_deg=crease
        )
        assert mesh.group_names == ("body", "lid", "handle", "spout")
        assert [group["faces"] for group in understood["groups"]] == np.bincount(
            mesh.face_groups
        ).tolist()


@pytest.mark.parametrize("angle", [0.0, -3.0, 181.0])
def test_angles_out_of_range_are_refused(store, angle):
    with pytest.raises(ValidationError, match="crease_angle_deg"):
        mesh_of(store, CUBE, crease_angle_deg=angle)
