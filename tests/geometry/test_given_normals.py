"""Normals of the file: those that fit are used, the others replaced and counted."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prtbake_workers.geometry.given_normals import unit_normals
from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import repair

SPHERE = icosphere(1)
FACES = icosphere_faces(1).astype(np.int64)
# six squares of a cube, each with four vertices of its own
AXES = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
_SIDES = np.stack([np.roll(AXES, 1, axis=1), np.cross(AXES, np.roll(AXES, 1, axis=1))], axis=1)
BOX = 0.5 * (AXES[:, None] + np.einsum("cs,fsx->fcx", [[1, 1], [-1, 1], [-1, -1], [1, -1]], _SIDES))
BOX = BOX.reshape(-1, 3)
BOX_FACES = (4 * np.arange(6)[:, None, None] + [[0, 1, 2], [0, 2, 3]]).reshape(-1, 3)
BOX_NORMALS = np.repeat(AXES, 4, axis=0)


def mend(positions, faces, normals, uv=None, **options):
    raw = RawMesh(
        np.asarray(positions, float), np.asarray(faces, np.int64), uv,
        normals=None if normals is None else np.asarray(normals, float),
    )  # fmt: skip
    return repair(raw, "test", **{"orient_outward": True, **options})


def corner_normals(mesh):
    return mesh.normals[mesh.faces]


def face_normals(mesh):
    vectors = face_area_vectors(mesh.positions, mesh.faces)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("length", [1e-300, 1e-20, 0.1, 1.0, 3e38, 1e300])
def test_lengths_do_not_matter(length):
    rows = length * np.array([[0.0, -1.0, 0.0], [0.36, 0.48, 0.8]])
    assert unit_normals(rows) == pytest.approx(np.array([[0, -1, 0], [0.36, 0.48, 0.8]]), rel=1e-14)
    assert (unit_normals(rows)[0] == [0.0, -1.0, 0.0]).all()


def test_no_normal_and_no_direction_stay_apart():
    units = unit_normals(np.array([[0.0, 0.0, 0.0], [np.nan] * 3, [1.0, np.nan, 0.0]]))
    assert (units[0] == 0.0).all()
    assert np.isnan(units[1:]).all()


def test_normals_that_fit_are_used_as_they_are():
    """Leaning ones, so that no computed normal could be taken for them."""
    leaning = SPHERE + np.array([0.0, 0.4, 0.0])
    mesh, report = mend(SPHERE, FACES, 7.0 * leaning)
    assert mesh.normals == pytest.approx(leaning / np.linalg.norm(leaning, axis=1)[:, None])
    assert (mesh.positions == SPHERE).all()
    assert report.has_normals
    assert (report.replaced_normals, report.turned_normals, report.warnings) == (0, 0, [])
    # the negative twin: without them the normals are others
    assert np.abs(mend(SPHERE, FACES, None)[0].normals - mesh.normals).max() > 0.2


def test_several_normals_at_one_position_stay_split():
    mesh, report = mend(BOX, BOX_FACES, BOX_NORMALS)
    assert (mesh.n_vertices, report.normal_split_vertices, report.duplicate_vertices) == (24, 16, 0)
    assert (corner_normals(mesh) == face_normals(mesh)[:, None]).all()
    assert (report.watertight, report.components, report.uv_seam_vertices) == (True, 1, 0)
    assert mesh.vertex_areas.sum() == pytest.approx(6.0)


def test_equal_normals_at_one_position_are_welded():
    corners = SPHERE[FACES].reshape(-1, 3)
    mesh, report = mend(corners, np.arange(FACES.size).reshape(-1, 3), corners)
    assert (mesh.n_vertices, report.duplicate_vertices) == (42, FACES.size - 42)
    assert mesh.normals == pytest.approx(mesh.positions)


@pytest.mark.parametrize("bad", [[0, 0, 0], [0, 0, -1]], ids=["zero", "backward"])
def test_a_side_without_usable_normals_gets_those_of_its_own_faces(bad):
    """As in the file BoxBadNormals: what is split in the file is not smoothed by the repair."""
    normals = BOX_NORMALS.copy()
    normals[8:12] = bad
    mesh, report = mend(BOX, BOX_FACES, normals)
    assert report.replaced_normals == 4
    assert any("4 vertices have a normal in the file" in warning for warning in report.warnings)
    assert (corner_normals(mesh) == face_normals(mesh)[:, None]).all()
    # were all faces at the position averaged, as where no normal is given, it would be a diagonal
    smooth, _ = mend(BOX, BOX_FACES, np.zeros((24, 3)))
    assert np.abs(corner_normals(smooth)).max() < 0.6


def test_a_file_without_one_usable_normal_is_as_one_without_normals():
    plain, _ = mend(BOX, BOX_FACES, None)
    for normals in (np.zeros((24, 3)), -BOX_NORMALS):
        mesh, report = mend(BOX, BOX_FACES, normals)
        assert (report.replaced_normals, report.has_normals) == (24, False)
        assert mesh.n_vertices == 8
        assert mesh.positions.tobytes() == plain.positions.tobytes()
        assert mesh.normals.tobytes() == plain.normals.tobytes()


@pytest.mark.parametrize(("degrees", "n_replaced"), [(89.0, 0), (91.0, 1), (180.0, 1)])
def test_ninety_degrees_off_one_face_are_too_much(degrees, n_replaced):
    """Two squares in one plane share a vertex whose normal leans towards the second one's rim."""
    positions = [[0, 0, 0], [1, 0, 0], [1, 0, -1], [0, 0, -1]]
    lean = np.deg2rad(degrees)
    normals = np.tile([0.0, 1.0, 0.0], (4, 1))
    normals[2] = [np.sin(lean), np.cos(lean), 0.0]
    mesh, report = mend(positions, [[0, 1, 2], [0, 2, 3]], normals)
    assert report.replaced_normals == n_replaced
    assert mesh.normals[2] == pytest.approx([0, 1, 0] if n_replaced else normals[2], abs=1e-15)


def test_one_face_of_several_is_enough_to_refuse():
    """Four steep sides about a tip: a normal that fits three of them is no use on the fourth."""
    positions = [[1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, 0, 1], [0, 3, 0]]
    faces = [[4, i, (i + 1) % 4] for i in range(4)]
    normals = np.full((5, 3), np.nan)
    normals[4] = [1.0, 0.5, 0.2]
    mesh, report = mend(positions, faces, normals)
    assert (report.replaced_normals, report.vertices_without_normal) == (1, 4)
    assert mesh.normals[4] == pytest.approx([0.0, 1.0, 0.0], abs=1e-15)


def test_vertices_without_normals_are_counted_and_computed():
    normals = SPHERE.copy()
    normals[[3, 17]] = np.nan
    mesh, report = mend(SPHERE, FACES, normals)
    assert (report.vertices_without_normal, report.replaced_normals) == (2, 0)
    plain, _ = mend(SPHERE, FACES, None)
    assert (mesh.normals[[3, 17]] == plain.normals[[3, 17]]).all()
    assert mesh.normals[4] == pytest.approx(SPHERE[4], abs=1e-15)
    assert any("2 vertices have no normal" in warning for warning in report.warnings)


def test_normals_turn_with_faces_that_are_turned_outward():
    """Wound inwards, and the normals follow: as horse.ply."""
    mesh, report = mend(SPHERE, FACES[:, ::-1], -SPHERE)
    assert (report.turned_normals, report.replaced_normals, report.flipped_faces) == (42, 0, 80)
    assert mesh.normals == pytest.approx(SPHERE, abs=1e-15)
    # left inside out, they stay as they are
    room, report = mend(SPHERE, FACES[:, ::-1], -SPHERE, orient_outward=False)
    assert (report.turned_normals, report.replaced_normals) == (0, 0)
    assert room.normals == pytest.approx(-SPHERE, abs=1e-15)


def test_normals_that_were_right_stay_when_faces_are_turned():
    leaning = unit_normals(SPHERE + np.array([0.0, 0.4, 0.0]))
    mesh, report = mend(SPHERE, FACES[:, ::-1], leaning)
    assert (report.turned_normals, report.replaced_normals) == (0, 0)
    assert mesh.normals == pytest.approx(leaning, abs=1e-15)
    # the negative twin: against faces that stay they are replaced
    room, report = mend(SPHERE, FACES[:, ::-1], leaning, orient_outward=False)
    assert report.replaced_normals == 42
    assert np.einsum("ij,ij->i", room.normals, SPHERE).max() < -0.9


def test_shuffled_winding_with_right_normals(rng):
    flip = rng.random(len(FACES)) < 0.4
    mesh, report = mend(SPHERE, np.where(flip[:, None], FACES[:, ::-1], FACES), SPHERE)
    assert report.flipped_faces == flip.sum()
    assert (report.turned_normals, report.replaced_normals) == (0, 0)
    assert mesh.normals == pytest.approx(SPHERE, abs=1e-15)


def test_a_soup_whose_normals_follow_each_winding_is_welded_once_they_are_turned(rng):
    flip = rng.random(len(FACES)) < 0.4
    corners = SPHERE[np.where(flip[:, None], FACES[:, ::-1], FACES)]
    normals = np.where(flip[:, None, None], -corners, corners)
    mesh, report = mend(
        corners.reshape(-1, 3), np.arange(FACES.size).reshape(-1, 3), normals.reshape(-1, 3)
    )
    assert mesh.n_vertices == 42
    assert report.normal_split_vertices == 0
    assert report.turned_normals > 0
    assert mesh.normals == pytest.approx(mesh.positions, abs=1e-15)


def test_uv_seams_are_told_from_splits_by_normals():
    uv = np.tile([0.5, 0.5], (24, 1))
    uv[:4] = [0.1, 0.1]
    _, report = mend(BOX, BOX_FACES, BOX_NORMALS, uv)
    assert (report.n_vertices, report.uv_seam_vertices, report.normal_split_vertices) == (24, 4, 12)


def test_a_crease_angle_takes_no_normal_of_the_file():
    for angle in (30.0, 120.0):
        mesh, report = mend(
            BOX, BOX_FACES, np.tile([0.0, 1.0, 0.0], (24, 1)), crease_angle_deg=angle
        )
        plain, _ = mend(BOX, BOX_FACES, None, crease_angle_deg=angle)
        assert mesh.normals.tobytes() == plain.normals.tobytes()
        assert mesh.n_vertices == plain.n_vertices == (24 if angle == 30.0 else 8)
        assert (report.has_normals, report.replaced_normals, report.warnings) == (False, 0, [])


@pytest.fixture(scope="module")
def computed_normals():
    return mend(SPHERE, FACES, None)[0].normals


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), spread=st.sampled_from([0.0, 0.5, 1.0, 3.0]))
def test_what_is_kept_fits_and_what_is_not_did_not(computed_normals, seed, spread):
    """Random normals about the true ones, some of them 0 or missing, against a loop over faces."""
    rng = np.random.default_rng(seed)
    normals = SPHERE + spread * rng.normal(size=SPHERE.shape)
    normals[rng.random(42) < 0.1] = 0.0
    normals[rng.random(42) < 0.1] = np.nan
    mesh, report = mend(SPHERE, FACES, normals)
    outward = face_area_vectors(SPHERE, FACES)
    fits = [
        all(normals[vertex] @ outward[face] > 0.0 for face in np.flatnonzero((vertex == FACES).any(1)))
        for vertex in range(42)
    ]  # fmt: skip
    missing = np.isnan(normals).any(axis=1)
    assert report.vertices_without_normal == missing.sum() * (not missing.all())
    assert report.replaced_normals == np.count_nonzero(~np.array(fits) & ~missing)
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0, abs=1e-12)
    expected = np.where(np.array(fits)[:, None], unit_normals(normals), computed_normals)
    assert mesh.normals == pytest.approx(expected, abs=1e-14)


@pytest.mark.real_data
def test_box_with_bad_normals_has_those_of_its_sides(data_dir):
    """Of the six sides one has normals of length 0 and one of length 0.1."""
    data = (data_dir / "meshes" / "hard" / "BoxBadNormals.glb").read_bytes()
    mesh, report = load_mesh(data, "glb")
    assert (mesh.n_vertices, report.replaced_normals, report.normal_split_vertices) == (24, 4, 16)
    # the node turns by a right angle, exactly
    assert (corner_normals(mesh) == face_normals(mesh)[:, None]).all()
    assert report.watertight
    # the negative twin: smooth, no corner is right
    smooth, _ = load_mesh(data, "glb", crease_angle_deg=180.0)
    assert np.abs(corner_normals(smooth) - face_normals(smooth)[:, None]).max(axis=2).min() > 0.4


@pytest.mark.real_data
def test_inside_out_horse_has_its_normals_turned_with_it(data_dir):
    """They follow the winding of the file and are sums of areas, 0.05 to 13 long."""
    mesh, report = load_mesh((data_dir / "meshes" / "horse.ply").read_bytes(), "ply")
    # 34 thin places have a face more than 90 degrees off
    assert (report.turned_normals, report.replaced_normals) == (48_451, 34)
    right, _ = load_mesh((data_dir / "meshes" / "horse.obj").read_bytes(), "obj")
    # the OBJ has none: those computed there lie close (measured 0.26 degrees in the median)
    _, one = np.unique(np.round(mesh.positions, 6), axis=0, return_index=True)
    _, two = np.unique(np.round(right.positions, 6), axis=0, return_index=True)
    cosine = np.einsum("ij,ij->i", mesh.normals[one], right.normals[two])
    assert np.degrees(np.arccos(np.median(np.clip(cosine, -1.0, 1.0)))) < 0.5
    assert cosine.min() > 0.8


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("name", "splits", "replaced"),
    [
        ("cornell-box/largebox.obj", 16, 0),
        ("gltf/BoxTextured.glb", 3, 0),
        ("gltf/Duck.glb", 122, 4),
        ("gltf/shaderball.glb", 15, 0),
        ("suzanne-uv.ply", 1410, 6),
        ("hard/quadknot.obj", 0, 0),
    ],
)
def test_real_files_keep_their_normals(data_dir, name, splits, replaced):
    mesh, report = load_mesh((data_dir / "meshes" / name).read_bytes(), "auto")
    assert report.has_normals
    assert (report.normal_split_vertices, report.replaced_normals) == (splits, replaced)
    kept = np.einsum("tci,ti->tc", corner_normals(mesh), face_normals(mesh)) > 0.0
    # a computed one may itself lie beyond 90 degrees of some face
    assert np.count_nonzero(~kept) <= 8 * replaced
