"""Creases: closed forms, a slow twin on meshes as bad as they come, and real CAD."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from prtbake_storage.errors import SettingsError
from prtbake_workers.geometry.creases import smoothing_groups, split_corners
from prtbake_workers.geometry.grouping import group_rows
from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import face_area_vectors, vertex_normals
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import repair

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def mend(positions, faces, crease_angle_deg, uv=None, *, orient_outward=True):
    raw = RawMesh(np.asarray(positions, float), np.asarray(faces, np.int64), uv)
    return repair(raw, "test", orient_outward=orient_outward, crease_angle_deg=crease_angle_deg)


def face_normals(mesh):
    vectors = face_area_vectors(mesh.positions, mesh.faces)
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def same_mesh(one, two):
    return all(
        getattr(one, name).tobytes() == getattr(two, name).tobytes()
        for name in ("positions", "faces", "normals")
    )


def test_a_cube_has_exact_axis_normals():
    mesh, report = mend(CUBE, CUBE_FACES, 30.0)
    assert (mesh.n_vertices, report.crease_vertices, report.crease_edges) == (24, 16, 12)
    # two triangles of one plane sum to a multiple of the axis: no rounding
    assert (mesh.normals[mesh.faces] == face_normals(mesh)[:, None]).all()
    assert set(np.abs(mesh.normals).sum(axis=1)) == {1.0}
    # what looks at positions sees the cube as before
    assert report.watertight
    assert (report.boundary_edges, report.components, report.uv_seam_vertices) == (0, 1, 0)
    assert (mesh.positions[mesh.faces] == CUBE[CUBE_FACES]).all()
    # each vertex has the thirds of its own side's triangles, and they still sum to the surface
    assert mesh.vertex_areas.sum() == pytest.approx(6.0, rel=1e-14)
    assert set(np.round(mesh.vertex_areas, 12)) == {round(1 / 6, 12), round(1 / 3, 12)}
    # the negative twin: without creases no corner has the normal of its side
    smooth, _ = mend(CUBE, CUBE_FACES, None)
    assert (smooth.normals[smooth.faces] * face_normals(smooth)[:, None]).sum(axis=2).max() < 0.6


@pytest.mark.parametrize(("angle", "n_vertices"), [(89.9, 24), (90.0, 8), (90.1, 8)])
def test_a_right_angle_is_not_more_than_a_right_angle(rng, angle, n_vertices):
    """Also where float32 coordinates of a turned box leave it a little more or a little less."""
    exceeded = 0
    for _ in range(20):
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        positions = (CUBE @ turn.T).astype(np.float32).astype(np.float64)
        mesh, _ = mend(positions, CUBE_FACES, angle)
        assert mesh.n_vertices == n_vertices
        normals = face_normals(mesh)
        exceeded += (normals[0] @ normals[4] < 0.0) or (normals[0] @ normals[8] < 0.0)
    # without the slack some of these boxes would have had creases at 90 degrees
    assert exceeded > 3


def cylinder(n):
    """n quads about the y axis, closed by fans about two centres."""
    angles = 2.0 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angles), np.zeros(n), -np.sin(angles)], axis=1)
    positions = np.concatenate([ring, ring + np.array([0.0, 1.0, 0.0]), [[0, 0, 0], [0, 1, 0]]])
    here, after = np.arange(n), (np.arange(n) + 1) % n
    low, high = np.full(n, 2 * n), np.full(n, 2 * n + 1)
    faces = [(here, after, after + n), (here, after + n, here + n), (after, here, low),
             (here + n, after + n, high)]  # fmt: skip
    return positions, np.concatenate([np.stack(corners, axis=1) for corners in faces])


def test_a_cylinder_keeps_smooth_sides_and_sharp_caps():
    n = 64
    mesh, report = mend(*cylinder(n), 30.0)
    assert (mesh.n_vertices, report.crease_vertices, report.crease_edges) == (
        4 * n + 2,
        2 * n,
        2 * n,
    )
    on_cap = np.abs(mesh.normals[:, 1]) == 1.0
    assert np.count_nonzero(on_cap) == 2 * n + 2
    assert (mesh.normals[on_cap, 1] == np.where(mesh.positions[on_cap, 1] > 0.5, 1.0, -1.0)).all()
    # a side vertex lies between two quads that mirror each other, with a right angle in each
    radial = mesh.positions[~on_cap] * [1.0, 0.0, 1.0]
    assert mesh.normals[~on_cap] == pytest.approx(radial, abs=1e-14)
    # the negative twins: an angle below that of two quads, and one above that of the rim
    faceted, _ = mend(*cylinder(n), 0.9 * 360.0 / n)
    assert faceted.n_vertices == 6 * n + 2
    assert np.abs(mend(*cylinder(n), 100.0)[0].normals[:n, 1]).min() > 0.3


@pytest.mark.parametrize("subdivisions", [0, 2])
def test_an_icosphere_at_180_equals_no_crease(subdivisions):
    positions, faces = icosphere(subdivisions), icosphere_faces(subdivisions)
    mesh, report = mend(positions, faces, 180.0)
    assert same_mesh(mesh, mend(positions, faces, None)[0])
    assert (report.crease_edges, report.crease_vertices) == (0, 0)
    # the negative twin: the icosahedron's faces meet at 41.8 degrees, those of its child at less
    sharp, report = mend(positions, faces, 15.0)
    assert (sharp.n_vertices == 60) == (subdivisions == 0) == (report.crease_vertices > 0)


def test_uv_seams_share_the_normal_of_their_smoothing_group():
    """A cube whose two halves differ in UV: seams through the middle of nothing but corners."""
    positions = np.concatenate([CUBE, CUBE])
    faces = CUBE_FACES + 8 * (np.arange(12)[:, None] % 2)
    uv = np.repeat([[0.0, 0.0], [1.0, 1.0]], 8, axis=0)
    mesh, report = mend(positions, faces, 30.0, uv)
    assert report.uv_seam_vertices == 8
    assert mesh.n_vertices == 8 + report.uv_seam_vertices + report.crease_vertices
    assert (mesh.normals[mesh.faces] == face_normals(mesh)[:, None]).all()
    # with no crease in reach, halves of one vertex keep one normal
    smooth, _ = mend(positions, faces, 120.0, uv)
    assert same_mesh(smooth, mend(positions, faces, None, uv)[0])
    assert len(np.unique(smooth.normals, axis=0)) == 8


def test_a_crease_that_ends_does_not_divide_its_end():
    """A cap with one ridge from its middle to its rim: about the middle all is joined."""
    n = 24
    turn = 2.0 * np.pi * np.arange(n) / n
    height = 1.2 * np.exp(-1.2 * np.minimum(turn, 2.0 * np.pi - turn))
    positions = np.stack([np.cos(turn), height, -np.sin(turn)], axis=1)
    positions = np.concatenate([positions, [[0.0, 0.0, 0.0]]])
    faces = np.array([[n, i, (i + 1) % n] for i in range(n)])
    # the ridge bends by 70 degrees, every other spoke by less than 15
    mesh, report = mend(positions, faces, 40.0)
    assert (report.crease_edges, report.crease_vertices) == (1, 1)
    assert np.count_nonzero((mesh.positions == 0.0).all(axis=1)) == 1
    assert np.count_nonzero((mesh.positions == positions[0]).all(axis=1)) == 2


def test_three_sheets_on_one_edge():
    """Non-manifold: sheets at 0, 20 and 90 degrees about y; the first two are one surface."""
    angles = np.deg2rad([0.0, 20.0, 90.0])
    tips = np.stack([np.cos(angles), np.full(3, 0.5), -np.sin(angles)], axis=1)
    positions = np.concatenate([[[0, 0, 0], [0, 1, 0]], tips])
    faces = np.array([[0, 2, 1], [0, 3, 1], [0, 4, 1]])
    mesh, report = mend(positions, faces, 30.0)
    assert (report.non_manifold_edges, report.crease_edges, report.crease_vertices) == (1, 1, 2)
    corners = mesh.faces[:, [0, 2]]
    assert (corners[0] == corners[1]).all()
    assert (corners[0] != corners[2]).all()
    # 20 to 90 are 70: a chain of links joins all three
    assert mend(positions, faces, 75.0)[1].crease_edges == 0
    assert mend(positions, faces, 10.0)[1].crease_vertices == 4


def test_degenerate_faces_make_no_creases():
    """Slivers along the edges of a cube, and faces of a repeated corner."""
    middle = 0.5 * (CUBE[0] + CUBE[1])
    positions = np.concatenate([CUBE, [middle]])
    faces = np.concatenate([CUBE_FACES, [[0, 8, 1], [3, 3, 1], [2, 3, 2]]])
    mesh, report = mend(positions, faces, 30.0)
    assert report.degenerate_faces == 3
    assert same_mesh(mesh, mend(CUBE, CUBE_FACES, 30.0)[0])


def test_a_sheet_folded_onto_itself_is_two():
    positions = [[0, 0, 0], [1, 0, 0], [0, 0, -1], [0.2, 0, -0.8]]
    mesh, report = mend(positions, [[0, 1, 2], [1, 0, 3]], 179.0)
    assert (report.crease_edges, report.crease_vertices) == (1, 2)
    assert np.abs(mesh.normals[:, 1]).tolist() == [1.0] * 6


def test_a_moebius_strip_stays_finite():
    n = 24
    turn = 2.0 * np.pi * np.arange(n) / n
    half = np.stack(
        [np.cos(turn / 2) * np.cos(turn), np.sin(turn / 2), np.cos(turn / 2) * np.sin(turn)], axis=1
    )
    ring = np.stack([np.cos(turn), 0.0 * turn, np.sin(turn)], axis=1)
    a, b = 2 * np.arange(n), 2 * np.arange(n) + 1
    c, d = np.roll(a, -1), np.roll(b, -1)
    c[-1], d[-1] = b[0], a[0]
    positions = np.stack([ring - 0.3 * half, ring + 0.3 * half], axis=1).reshape(-1, 3)
    mesh, report = mend(
        positions, np.concatenate([np.stack([a, b, c], 1), np.stack([c, b, d], 1)]), 60.0
    )
    assert not report.orientable
    # the two triangles whose winding clashes face opposite ways: one edge there
    assert report.crease_edges == 1
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize("angle", [0.0, -1.0, 180.1, np.nan, np.inf])
def test_angles_out_of_range_are_refused(angle):
    with pytest.raises(SettingsError, match="crease_angle_deg"):
        mend(CUBE, CUBE_FACES, angle)


def slow_groups(positions, faces, place, angle):
    """Corners that share a normal, by search: the twin of `smoothing_groups`.

    A set of frozen sets of corners, and the number of creases.
    """
    vectors = face_area_vectors(positions, faces)
    normals = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    by_place = place[faces]
    faces_at = {}
    for face, corners in enumerate(by_place):
        for i in range(3):
            faces_at.setdefault(frozenset((corners[i], corners[i - 2])), []).append(face)
    linked, creased = set(), set()
    for edge, around in faces_at.items():
        # every pair, and what can be reached over pairs
        reached = [around[0]]
        for face in reached:
            reached += [
                other for other in around
                if other not in reached
                and np.degrees(np.arccos(np.clip(normals[face] @ normals[other], -1, 1))) <= angle
            ]  # fmt: skip
        if len(reached) < len(around):
            creased.add(edge)
        for face in around:
            for other in around:
                cosine = np.clip(normals[face] @ normals[other], -1, 1)
                if np.degrees(np.arccos(cosine)) <= angle:
                    linked.add((face, other, edge))
    groups = set()
    for position in np.unique(by_place):
        corners = [(f, i) for f, i in np.argwhere(by_place == position)]
        if not any(position in edge for edge in creased):
            groups.add(frozenset(corners))
            continue
        while corners:
            group = [corners.pop(0)]
            for face, _ in group:
                joined = [
                    corner for corner in corners
                    if any(position in e and (face, corner[0]) == (f, g) for f, g, e in linked)
                ]  # fmt: skip
                corners = [corner for corner in corners if corner not in joined]
                group += joined
            groups.add(frozenset(group))
    return groups, len(creased)


@st.composite
def bad_meshes(draw):
    """Few positions and many faces between them: folds, fins, bow-ties, edges of many faces."""
    n = draw(st.integers(4, 9))
    seed = draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    positions = rng.integers(0, 4, (n, 3)).astype(float)
    faces = np.array([rng.choice(n, 3, replace=False) for _ in range(draw(st.integers(2, 14)))])
    areas = np.linalg.norm(face_area_vectors(positions, faces), axis=1)
    faces = faces[areas > 0.0]
    assume(len(faces) > 1)
    used, faces = np.unique(faces, return_inverse=True)
    return positions[used], faces.reshape(-1, 3).astype(np.int64)


@settings(max_examples=60, deadline=None)
@given(mesh=bad_meshes(), angle=st.sampled_from([1.3, 33.3, 61.7, 90.1, 133.3, 177.7, 180.0]))
def test_groups_are_those_of_the_slow_twin(mesh, angle):
    positions, faces = mesh
    place, _ = group_rows(positions)
    groups, n_creases = smoothing_groups(positions, faces, place, angle)
    found = {}
    for (face, corner), group in np.ndenumerate(groups):
        found.setdefault(group, set()).add((face, corner))
    expected, n_expected = slow_groups(positions, faces, place, angle)
    assert {frozenset(corners) for corners in found.values()} == expected
    assert n_creases == n_expected


@settings(max_examples=40, deadline=None)
@given(mesh=bad_meshes())
def test_any_mesh_at_180_equals_no_crease_to_the_last_bit(mesh):
    assert same_mesh(mend(*mesh, 180.0)[0], mend(*mesh, None)[0])


@settings(max_examples=30, deadline=None)
@given(mesh=bad_meshes(), angle=st.sampled_from([20.0, 75.0, 130.0]), seed=st.integers(0, 99))
def test_the_split_changes_no_triangle_and_depends_on_no_order(mesh, angle, seed):
    positions, faces = mesh
    split, report = mend(positions, faces, angle)
    plain, _ = mend(positions, faces, None)
    assert (split.positions[split.faces] == plain.positions[plain.faces]).all()
    assert split.vertex_areas.sum() == pytest.approx(plain.vertex_areas.sum(), rel=1e-12)
    assert split.n_vertices == plain.n_vertices + report.crease_vertices
    assert np.linalg.norm(split.normals, axis=1) == pytest.approx(1.0, abs=1e-12)
    # the copies of a vertex follow each other, in the order of the vertices
    group, first = group_rows(split.positions)
    assert (np.diff(group) >= 0).all()
    assert (split.positions[first] == plain.positions[group_rows(plain.positions)[1]]).all()
    assert same_mesh(split, mend(positions, faces, angle)[0])
    # winding may follow the first face where a piece has no outside, so it is held here
    place, _ = group_rows(plain.positions)
    kept = plain.faces.astype(np.int64)
    shuffle = np.random.default_rng(seed).permutation(len(kept))
    one, two = (
        smoothing_groups(plain.positions, order, place, angle)[0] for order in (kept, kept[shuffle])
    )
    same = one[shuffle].ravel()[:, None] == one[shuffle].ravel()
    assert (same == (two.ravel()[:, None] == two.ravel())).all()


def test_split_corners_keeps_the_order_of_the_vertices():
    faces = np.array([[0, 1, 2], [2, 1, 3]])
    split, source, group = split_corners(faces, np.array([[7, 5, 9], [9, 4, 7]]))
    assert source.tolist() == [0, 1, 1, 2, 3]
    assert group.tolist() == [7, 4, 5, 9, 7]
    assert (source[split] == faces).all()
    assert all(a <= b for a, b in pairwise(source))


@pytest.mark.real_data
def test_fandisk_is_sharp_where_its_faces_meet(data_dir):
    """A CAD part: flat and curved faces, between them edges of 45 to 90 degrees."""
    data = (data_dir / "meshes" / "fandisk.obj").read_bytes()
    smooth, _ = load_mesh(data, "obj")
    mesh, report = load_mesh(data, "obj", crease_angle_deg=30.0)
    assert (mesh.n_vertices, report.crease_edges) == (7207, 722)
    assert report.crease_vertices == 7207 - 6475 == mesh.n_vertices - smooth.n_vertices
    assert report.watertight

    def deviation(found):
        """Degrees between each corner's normal and that of its face."""
        cosine = np.einsum("tci,ti->tc", found.normals[found.faces], face_normals(found))
        return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))

    # measured 17.6 and 75.6; rounded edges take more than a tenth of all corners off by 30
    assert deviation(mesh).max() < 20.0
    assert deviation(smooth).max() > 75.0
    assert (deviation(smooth) > 30.0).mean() > 0.1
    # away from creases nothing has changed
    place, _ = group_rows(mesh.positions)
    alone = (np.bincount(place) == 1)[place[mesh.faces]].all(axis=1)
    assert (mesh.normals[mesh.faces[alone]] == smooth.normals[smooth.faces[alone]]).all()
    assert alone.mean() > 0.75
    # at them the normal is the mean over the part of the fan on one side: by another road, the
    # normals of the mesh as it would be if it had been split in the file
    again = vertex_normals(mesh.positions, mesh.faces)
    assert again == pytest.approx(mesh.normals, abs=1e-12)


@pytest.mark.real_data
@pytest.mark.parametrize(
    "name", ["spot/spot_triangulated.obj", "hard/dragon_vrip_res4.ply", "hard/moebius.obj"]
)
def test_real_meshes_at_180_equal_no_crease(data_dir, name):
    data = (data_dir / "meshes" / name).read_bytes()
    one, _ = load_mesh(data, "auto")
    two, _ = load_mesh(data, "auto", crease_angle_deg=180.0)
    assert same_mesh(one, two)
