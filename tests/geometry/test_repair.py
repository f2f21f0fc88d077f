"""The repair and its report."""

import json

import numpy as np
import pytest

from prtbake_storage.errors import MeshError
from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import DEGENERATE_HEIGHT, repair

SPHERE = icosphere(1)
FACES = icosphere_faces(1).astype(np.int64)


def mend(positions, faces, uv=None, *, orient_outward=True):
    raw = RawMesh(np.asarray(positions, float), np.asarray(faces, np.int64), uv)
    return repair(raw, "test", orient_outward=orient_outward)


def test_sound_mesh_comes_back_unchanged():
    mesh, report = mend(SPHERE, FACES)
    assert (mesh.positions == SPHERE).all()
    assert (mesh.faces == FACES).all()
    assert report.watertight
    assert report.orientable
    assert report.components == 1
    found = report.to_dict()
    json.dumps(found)
    assert not any(
        found[key]
        for key in (
            "unreferenced_vertices", "duplicate_vertices", "degenerate_faces", "duplicate_faces",
            "clashing_edges", "flipped_faces", "boundary_edges", "non_manifold_edges", "warnings",
        )
    )  # fmt: skip


def test_unreferenced_vertices_go_and_order_stays():
    positions = np.insert(SPHERE, [0, 5, 5], [[9.0, 9, 9]], axis=0)
    renumber = np.arange(42) + 1 + 2 * (np.arange(42) >= 5)
    mesh, report = mend(positions, renumber[FACES])
    assert report.unreferenced_vertices == 3
    assert (mesh.positions == SPHERE).all()


def test_triangle_soup_is_welded():
    mesh, report = mend(SPHERE[FACES].reshape(-1, 3), np.arange(FACES.size).reshape(-1, 3))
    assert report.duplicate_vertices == FACES.size - len(SPHERE)
    assert mesh.n_vertices == len(SPHERE)
    assert report.watertight


def test_negative_zero_is_zero():
    mesh, report = mend([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -0.0, 0], [0, 1, -0.0], [-1, 0, 0]],
                        [[0, 1, 2], [3, 4, 5]])  # fmt: skip
    assert report.duplicate_vertices == 2
    assert mesh.n_vertices == 4


def test_uv_seams_stay_split_and_share_normals():
    positions = np.concatenate([SPHERE, SPHERE])
    uv = np.concatenate([np.zeros((42, 2)), np.ones((42, 2))])
    faces = np.where(np.arange(len(FACES))[:, None] % 2 == 0, FACES, FACES + 42)
    mesh, report = mend(positions, faces, uv)
    assert report.uv_seam_vertices > 0
    assert report.watertight
    assert report.duplicate_vertices == 0
    plain, _ = mend(SPHERE, FACES)
    place = (mesh.positions[:, None] == SPHERE[None]).all(axis=2).argmax(axis=1)
    # the same sums in another order
    assert mesh.normals == pytest.approx(plain.normals[place], abs=1e-14)


@pytest.mark.parametrize("height", [0.0, 0.1 * DEGENERATE_HEIGHT])
def test_degenerate_faces_go(height):
    """A repeated corner, corners on a line, and a triangle too flat for float32."""
    positions = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, height, 0], [0, 0, 0]]
    faces = [[0, 1, 2], [0, 0, 1], [0, 4, 1], [0, 1, 3]]
    mesh, report = mend(positions, faces)
    assert report.degenerate_faces == 3
    assert mesh.n_faces == 1
    assert mesh.n_vertices == 3


def test_flat_but_sound_faces_stay():
    positions = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.5, -10.0 * DEGENERATE_HEIGHT, 0]]
    mesh, report = mend(positions, [[0, 1, 2], [1, 0, 3]])
    assert report.degenerate_faces == 0
    assert mesh.n_faces == 2


@pytest.mark.parametrize("scale", [1e-12, 1e-4, 1.0, 1e4, 1e12])
def test_scale_changes_nothing(scale):
    mesh, report = mend(scale * SPHERE, FACES)
    assert report.degenerate_faces == 0
    assert mesh.n_faces == len(FACES)
    assert mesh.normals == pytest.approx(mend(SPHERE, FACES)[0].normals, abs=1e-12)


def test_duplicate_faces_of_either_winding_go():
    faces = np.concatenate([FACES, FACES[:5, ::-1], FACES[5:8], np.roll(FACES[8:9], 1, axis=1)])
    mesh, report = mend(SPHERE, faces)
    assert report.duplicate_faces == 9
    assert (mesh.faces == FACES).all()


def test_inside_out_is_turned_or_left_as_asked():
    mesh, report = mend(SPHERE, FACES[:, ::-1])
    assert report.pieces_turned_outward == 1
    assert report.flipped_faces == len(FACES)
    assert np.einsum("ij,ij->i", mesh.normals, SPHERE).min() > 0.9
    mesh, report = mend(SPHERE, FACES[:, ::-1], orient_outward=False)
    assert report.pieces_left_inside_out == 1
    assert report.flipped_faces == 0
    assert np.einsum("ij,ij->i", mesh.normals, SPHERE).max() < -0.9


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e20])
def test_unusable_positions_are_named(value):
    positions = SPHERE.copy()
    positions[17, 1] = value
    with pytest.raises(MeshError, match=r"vertex 17 \(counted from 0\).*1 such vertices"):
        mend(positions, FACES)


def test_labels_name_the_vertex_of_the_file():
    positions = SPHERE.copy()
    positions[17, 1] = np.nan
    raw = RawMesh(positions, FACES, None, np.arange(42) + 100)
    with pytest.raises(MeshError, match="vertex 117 "):
        repair(raw, "obj", orient_outward=True)


def test_bad_corner_is_named():
    faces = FACES.copy()
    faces[3, 1] = 42
    with pytest.raises(MeshError, match=r"triangle 3 .* 42 vertices"):
        mend(SPHERE, faces)


@pytest.mark.parametrize(
    ("positions", "faces", "message"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3)), "holds nothing"),
        (np.zeros((5, 3)), np.zeros((0, 3)), "holds 5 points"),
        (np.zeros((3, 3)), [[0, 1, 2]], "all 1 of the file have no area"),
    ],
)
def test_nothing_to_bake_is_refused(positions, faces, message):
    with pytest.raises(MeshError, match=message):
        mend(positions, faces)


def test_missing_texture_coordinates_are_counted():
    uv = np.full((42, 2), 0.5)
    uv[3] = np.nan
    mesh, report = mend(SPHERE, FACES, uv)
    assert report.vertices_without_uv == 1
    assert mesh.uv[3].tolist() == [0.0, 0.0]
    assert any("texture coordinate" in warning for warning in report.warnings)
    mesh, _ = mend(SPHERE, FACES, np.full((42, 2), np.nan))
    assert mesh.uv is None
