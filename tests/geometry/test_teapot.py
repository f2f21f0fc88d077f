"""The procedural teapot."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.grouping import group_rows
from prtbake_workers.geometry.loading import load_mesh
from prtbake_workers.geometry.mesh import Mesh, face_area_vectors, vertex_normals
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.teapot import control_points, teapot
from prtbake_workers.geometry.topology import count_components, find_edges


@pytest.mark.parametrize("tessellation", [1, 2, 3, 7, 10, 16])
def test_seams_are_welded_and_winding_agrees(tessellation):
    mesh = teapot(tessellation)
    faces = mesh.faces.astype(np.int64)
    edges = find_edges(faces)
    # open: rim and lid, one ring of four patches each; handle and spout, both ends of two patches
    across = max(tessellation, 2)
    assert edges.n_boundary == 2 * 4 * tessellation + 4 * 2 * across
    assert edges.n_non_manifold == 0
    assert not edges.clashing.any()
    assert count_components(faces) == 4
    assert len(np.unique(faces)) == mesh.n_vertices


@pytest.mark.parametrize("tessellation", [1, 2, 5, 12])
def test_no_triangle_is_degenerate(tessellation):
    mesh = teapot(tessellation)
    corners = mesh.positions[mesh.faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    area = np.linalg.norm(face_area_vectors(mesh.positions, mesh.faces), axis=1)
    # the narrowest are those of the rim at tessellation 1: 0.017
    assert (area / longest**2).min() > 0.01


def test_size_is_that_of_the_usual_model():
    mesh = teapot(10)
    extents = mesh.bounds[1] - mesh.bounds[0]
    assert extents == pytest.approx([6.434, 3.15, 4.0], abs=1e-12)
    assert mesh.bounds[0, 1] == 0.0
    # and a teapot without its pole patches would be found
    assert np.abs(mesh.positions[:, [0, 2]]).sum(axis=1).min() == 0.0


def boundary_vertices(mesh):
    """Vertices of edges with one face; the triangles see the surface on one side of them only."""
    faces = mesh.faces.astype(np.int64)
    edges = find_edges(faces)
    halves = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2)
    return np.unique(halves[edges.n_faces_at[edges.edge_of] == 1])


def test_normals_are_those_of_the_surface():
    """The derivatives of the patches against the triangles of a finer teapot."""
    mesh = teapot(4)
    errors = []
    for finer in (16, 32):
        fine = teapot(finer)
        distance, nearest = KDTree(fine.positions).query(mesh.positions)
        assert distance.max() < 1e-12
        normals = vertex_normals(fine.positions, fine.faces)[nearest]
        inner = np.setdiff1d(np.arange(mesh.n_vertices), boundary_vertices(mesh))
        # handle and body have one point in common
        inner = inner[np.abs(mesh.positions[inner] - [-2.0, 0.9, 0.0]).max(axis=1) > 0.0]
        cosines = np.einsum("ij,ij->i", mesh.normals, normals)[inner]
        errors.append(np.sqrt(np.mean(2.0 - 2.0 * cosines)))
    # the triangles converge to the derivatives (measured 0.0424 and 0.0218)
    assert errors[1] < 0.6 * errors[0] < 0.03


@pytest.mark.parametrize("tessellation", [1, 2, 8])
def test_normals_stay_unit_and_near_their_triangles(tessellation):
    mesh = teapot(tessellation)
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1.0).max() < 1e-14
    fronts = vertex_normals(mesh.positions, mesh.faces)
    assert np.einsum("ij,ij->i", mesh.normals, fronts).min() >= 0.5


def test_outside_is_outside():
    """From a point outside the bounding box every first hit shows its front.

    Only the open spout, and the gap between lid and rim, let a ray see a back.
    """
    mesh = teapot(8)
    centre, eye_distance = mesh.bounds.mean(axis=0), 10.0
    directions = np.random.default_rng(0).normal(size=(4000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # not at the vertices: there a ray can slip through between the triangles
    targets = mesh.positions[mesh.faces].mean(axis=1)
    targets = targets[np.random.default_rng(1).integers(0, mesh.n_faces, 4000)]
    origins = centre + eye_distance * directions
    rays = targets - origins
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)

    def share_of_fronts(shape):
        hits = Accelerator(shape.positions, shape.faces).intersect(
            origins.astype(np.float32), rays.astype(np.float32)
        )
        hit = hits.triangles >= 0
        vectors = face_area_vectors(shape.positions, shape.faces)[hits.triangles[hit]]
        return np.mean(np.einsum("ij,ij->i", vectors, rays[hit]) < 0.0)

    assert share_of_fronts(mesh) > 0.99
    inside_out = Mesh(mesh.positions, mesh.faces[:, ::-1], -mesh.normals)
    assert share_of_fronts(inside_out) < 0.01


def test_top_of_the_lid_sees_the_sky():
    mesh = teapot(6)
    top = mesh.positions[:, 1].argmax()
    assert mesh.normals[top] == pytest.approx([0.0, 1.0, 0.0], abs=1e-12)
    epsilon = ray_epsilon(mesh.bounds)
    origin = offset_origins(mesh.positions[[top]], mesh.normals[[top]], epsilon)
    up = np.array([[0.0, 1.0, 0.0]], np.float32)
    assert not Accelerator(mesh.positions, mesh.faces).occluded(origin, up)[0]


@pytest.mark.parametrize("tessellation", [0, 65])
def test_bad_tessellation_is_refused(tessellation):
    with pytest.raises(ValueError, match="tessellation must lie"):
        teapot(tessellation)


def read_csv(path):
    points, patches = [], []
    for line in path.read_text().splitlines():
        kind, _, numbers = line.partition(",")
        if kind == "p":
            points.append([float(x) for x in numbers.split(",")])
        elif kind == "b":
            patches.append([int(i) - 1 for i in numbers.split(",")])
    return np.array(points)[:, [0, 2, 1]] * [1.0, 1.0, -1.0], np.array(patches)


@pytest.mark.real_data
def test_control_points_are_newells(data_dir):
    points, patches = read_csv(data_dir / "meshes" / "newell-teapot-patches.csv")

    def as_sets(controls):
        return sorted(
            sorted(map(tuple, np.round(control.reshape(-1, 3), 9) + 0.0)) for control in controls
        )

    assert as_sets(points[patches]) == as_sets(control_points())


@pytest.mark.real_data
def test_tessellation_10_is_the_usual_file(data_dir):
    usual, _ = load_mesh((data_dir / "meshes" / "teapot.obj").read_bytes(), "obj")
    mesh = teapot(10)
    assert mesh.bounds == pytest.approx(usual.bounds, abs=1e-6)
    assert mesh.n_faces == usual.n_faces
    assert mesh.vertex_areas.sum() == pytest.approx(usual.vertex_areas.sum(), rel=1e-6)
    # the same points, to the six digits of the file; one point of handle and body is welded there
    _, first = group_rows(np.round(mesh.positions, 4))
    ours = set(map(tuple, np.round(mesh.positions[first], 4) + 0.0))
    theirs = set(map(tuple, np.round(usual.positions, 4) + 0.0))
    assert len(ours ^ theirs) < 0.02 * len(theirs)
