"""Areas and normals of meshes."""

import numpy as np
import pytest

from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces
from prtbake_workers.geometry.mesh import Mesh, corner_angles, vertex_areas, vertex_normals

CUBE = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
CUBE_FACES = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def test_corner_angles_of_a_known_triangle():
    positions = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0]])
    angles = corner_angles(positions, np.array([[0, 1, 2]]))
    assert angles[0] == pytest.approx([np.pi / 2, np.pi / 4, np.pi / 4], rel=1e-15)


def test_corner_angles_of_slivers_sum_to_pi():
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]])
    angles = corner_angles(positions, np.array([[0, 1, 2]]))
    # acos of the dot product would be off by 1e-8 here
    assert angles.sum() == pytest.approx(np.pi, rel=1e-15)
    assert angles[0, 0] == pytest.approx(2e-9, rel=1e-12)


def test_cube_normals_point_along_the_diagonals():
    normals = vertex_normals(CUBE, CUBE_FACES)
    # each corner sees three right angles in all, however its squares are cut
    assert normals == pytest.approx((2.0 * CUBE - 1.0) / np.sqrt(3.0), rel=1e-14)


def test_area_weights_would_fail_the_cube():
    """The negative twin: weights by area depend on the cut of the squares."""
    corners = CUBE[CUBE_FACES]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = np.zeros((8, 3))
    np.add.at(sums, CUBE_FACES.ravel(), np.repeat(face_normals, 3, axis=0))
    normals = sums / np.linalg.norm(sums, axis=1, keepdims=True)
    assert np.abs(normals - (2.0 * CUBE - 1.0) / np.sqrt(3.0)).max() > 0.1


def test_sphere_normals_converge_to_the_true_ones():
    errors = []
    for subdivisions in (2, 3):
        points = icosphere(subdivisions)
        normals = vertex_normals(points, icosphere_faces(subdivisions))
        errors.append(np.abs(normals - points).max())
    # half the edge length halves the error (measured 0.0104, 0.0052)
    assert errors[1] < 0.55 * errors[0] < 0.01


def test_groups_share_a_normal():
    """Two squares meeting at a right angle along a seam of split vertices."""
    positions = np.array(
        [[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1], [0, 0, 0], [0, 0, 1], [0, 1, 1], [0, 1, 0]]
    )
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 6, 5], [4, 7, 6]])
    groups = np.array([0, 1, 2, 3, 0, 3, 4, 5])
    shared = vertex_normals(positions, faces, groups)
    assert (shared[0] == shared[4]).all()
    assert (shared[3] == shared[5]).all()
    alone = vertex_normals(positions, faces)
    assert np.abs(alone[0] - alone[4]).max() > 0.5


def test_cancelling_faces_still_give_a_unit_normal():
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    normals = vertex_normals(positions, np.array([[0, 1, 2], [0, 2, 1]]))
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1.0)
    assert np.abs(normals[:, 2]) == pytest.approx(1.0)


def test_vertex_of_no_face_gets_the_upward_normal():
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 1], [5, 5, 5]])
    normals = vertex_normals(positions, np.array([[0, 1, 2]]))
    assert (normals[3] == [0.0, 1.0, 0.0]).all()


def test_vertex_areas_sum_to_the_surface():
    mesh = Mesh(CUBE, CUBE_FACES.astype(np.int32), vertex_normals(CUBE, CUBE_FACES))
    assert mesh.vertex_areas.sum() == pytest.approx(6.0, rel=1e-14)
    # a corner of one triangle holds a third of 1/2
    areas = vertex_areas(CUBE, CUBE_FACES[:1])
    assert areas[[0, 1, 3]] == pytest.approx(1.0 / 6.0)
    assert areas[[2, 4, 5, 6, 7]].max() == 0.0


def test_bounds_and_diagonal():
    mesh = Mesh(CUBE, CUBE_FACES.astype(np.int32), vertex_normals(CUBE, CUBE_FACES))
    assert mesh.bounds.tolist() == [[0, 0, 0], [1, 1, 1]]
    assert mesh.diagonal == pytest.approx(np.sqrt(3.0))
    assert (mesh.n_vertices, mesh.n_faces) == (8, 12)
