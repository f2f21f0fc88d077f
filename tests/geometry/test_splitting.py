"""Cutting a mesh into parts changes nothing but who owns a vertex."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import repair
from prtbake_workers.geometry.scene import Scene, bodies_of
from prtbake_workers.geometry.splitting import split_mesh
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.directions import cube_directions
from support.bounce_scenes import opaque

CUBE = cube_directions(8)
BASIS = SrbfBasis(icosphere(1))
PROJECTION = BASIS.projection(CUBE.directions, CUBE.weights)
DIFFUSE = factorise(Lambert(np.array([0.5])))
GLOSSY = factorise(CookTorrance(np.array([0.3]), np.array([0.7]), 0.4, np.array([0.1])), n_terms=4)


def open_box():
    """Five sides of a box with creases, quartered: borders meet open edges, creases and corners."""
    side = grid_mesh(4, 4)
    turns = [np.eye(3)]
    for axis in ([1, 0, 0], [-1, 0, 0], [0, 0, 1], [0, 0, -1]):
        up = np.array(axis, float)
        across = np.array([0.0, 1.0, 0.0])
        turns.append(np.stack([across, up, np.cross(across, up)]))
    positions = np.concatenate([side.positions @ turn - (0.5 * turn[1]) for turn in turns])
    faces = np.concatenate([side.faces + i * side.n_vertices for i in range(5)]).astype(np.int64)
    mesh, report = repair(
        RawMesh(np.round(positions, 12), faces), "test", orient_outward=False, crease_angle_deg=60.0
    )
    assert report.boundary_edges == 16
    assert report.crease_vertices > 0
    return mesh


def seamed_grid():
    """A sheet with a seam of texture coordinates along its middle, up to its open edge."""
    sheet = grid_mesh(6, 6)
    right = sheet.positions[sheet.faces].mean(axis=1)[:, 0] > 0.0
    halves = split_mesh(sheet, right.astype(np.int64))
    uv = [half.uv + shift for half, shift in zip(halves, (0.0, 3.0), strict=True)]
    return Mesh(
        np.concatenate([half.positions for half in halves]),
        np.concatenate([halves[0].faces, halves[1].faces + halves[0].n_vertices]),
        np.concatenate([half.normals for half in halves]),
        np.concatenate(uv),
    )


SHAPES = {"open box": open_box, "teapot": lambda: teapot(3), "seamed": seamed_grid}


def halves_of(mesh):
    """Part of each face: a zigzag of faces above and below a slanted plane."""
    middles = mesh.positions[mesh.faces].mean(axis=1)
    height = (middles - mesh.positions.mean(axis=0)) @ np.array([0.35, 0.6, 0.72])
    return (height > 0.0).astype(np.int64)


def scenes_of(mesh, *, bodies=(0, 0)):
    """Whole and cut scene, and for each vertex of the cut one its number in the whole."""
    part_of_face = halves_of(mesh)
    parts = split_mesh(mesh, part_of_face)
    source = np.concatenate([np.unique(mesh.faces[part_of_face == part]) for part in (0, 1)])
    # the cut goes through the surface: some vertices are on both sides of it
    assert len(source) > mesh.n_vertices
    return Scene.from_parts([mesh]), Scene.from_parts(parts, bodies=bodies), source


@pytest.mark.parametrize("name", SHAPES)
def test_rays_start_where_they_started_before_the_cut(name):
    whole, cut, source = scenes_of(SHAPES[name]())
    # sums over the triangles of a vertex are made in another order
    np.testing.assert_allclose(cut.ray_points, whole.ray_points[source], rtol=0, atol=1e-14)
    np.testing.assert_allclose(cut.ray_sides, whole.ray_sides[source], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(cut.frames, whole.frames[source])
    # a doubled vertex shares its area out
    areas = np.bincount(source, cut.areas, whole.n_vertices)
    np.testing.assert_allclose(areas, whole.areas, rtol=1e-13)
    # negative twin: taken for bodies of their own, the parts have open edges along the cut
    _, torn, _ = scenes_of(SHAPES[name](), bodies=None)
    moved = np.abs(torn.ray_points - whole.ray_points[source]).max(axis=1)
    assert np.count_nonzero(moved > 1e-8) > 5


def bake(scene, factorisation):
    accelerator = Accelerator(scene.positions, scene.faces)
    return np.concatenate(
        [
            bake_block(
                scene, accelerator, span, factorisation=factorisation, projection=PROJECTION,
                directions=CUBE,
            ).coefficients
            for span in scene.part_ranges
        ]
    )  # fmt: skip


@pytest.mark.parametrize("factorisation", [DIFFUSE, GLOSSY], ids=["diffuse", "glossy"])
@pytest.mark.parametrize("name", SHAPES)
def test_a_cut_mesh_of_one_material_has_the_transfer_of_the_whole(name, factorisation):
    whole, cut, source = scenes_of(SHAPES[name]())
    expected = bake(whole, factorisation)[source]
    # products in blocks of other vertices: float32 rounding
    tolerance = 4e-6 * np.abs(expected).max()
    np.testing.assert_allclose(bake(cut, factorisation), expected, rtol=0, atol=tolerance)
    if name == "open box" and factorisation is DIFFUSE:
        # negative twin: rays that start inside a torn edge see something else
        _, torn, _ = scenes_of(SHAPES[name](), bodies=None)
        off = np.abs(bake(torn, factorisation) - expected).max(axis=(1, 2))
        assert np.count_nonzero(off > 100 * tolerance) > 0


def test_bounced_light_does_not_break_at_a_border():
    """Both halves of a doubled vertex draw the same rays, so their bounces are the same."""
    mesh = teapot(3)
    _, cut, source = scenes_of(mesh)
    direct = bake(cut, DIFFUSE)
    sent = [direct[start:stop] for start, stop in cut.part_ranges]

    def bounced(scene):
        block = bounce_block(
            opaque(scene), sent, factorisations=[DIFFUSE] * 2, albedo=Albedo.constant(0.8),
            n_channels=1, n_rays=[16, 16], seed=3, max_bounces=2, tolerance=0.0,
        )  # fmt: skip
        return np.concatenate(block.added)

    added = bounced(cut)
    order = np.argsort(source, kind="stable")
    pairs = order[:-1][np.diff(source[order]) == 0], order[1:][np.diff(source[order]) == 0]
    assert len(pairs[0]) > 10
    scale = np.abs(added).max()
    # the direct light that they pass on was equal to rounding
    np.testing.assert_allclose(added[pairs[0]], added[pairs[1]], rtol=0, atol=1e-5 * scale)
    # negative twin: as bodies of their own they draw their own
    torn = bounced(scenes_of(mesh, bodies=None)[1])
    assert np.abs(torn[pairs[0]] - torn[pairs[1]]).max() > 0.01 * scale


def test_parts_of_the_object_are_one_body_and_a_receiver_is_its_own():
    assert bodies_of(["object", "object", "receiver"]) == (0, 0, 3)
    assert bodies_of(["object"]) == (0,)


BALL = sphere_mesh(1)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(0, 4), min_size=BALL.n_faces, max_size=BALL.n_faces))
def test_splitting_and_joining_keeps_every_triangle(labels):
    part_of_face = np.unique(labels, return_inverse=True)[1].reshape(-1)
    parts = split_mesh(BALL, part_of_face)
    scene = Scene.from_parts(parts, bodies=(0,) * len(parts))
    order = np.argsort(part_of_face, kind="stable")
    np.testing.assert_array_equal(scene.positions[scene.faces], BALL.positions[BALL.faces[order]])
    np.testing.assert_array_equal(scene.normals[scene.faces], BALL.normals[BALL.faces[order]])
    np.testing.assert_array_equal(scene.part_of_face, part_of_face[order])
    # nothing is left over, and no vertex is in a part without a face of it
    assert all(len(np.unique(part.faces)) == part.n_vertices for part in parts)
    np.testing.assert_array_equal(scene.positions[scene.twins], scene.positions)
    assert len(np.unique(scene.twins)) == BALL.n_vertices
