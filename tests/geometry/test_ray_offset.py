"""Offsets of ray origins."""

import numpy as np
import pytest

from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.ray_offset import (
    INSET,
    inset_boundary,
    offset_origins,
    ray_epsilon,
    ray_sides,
    self_hit_count,
)
from prtbake_workers.geometry.repair import repair
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot

SCALES = [1e-4, 1.0, 1e4]


def scaled(mesh, scale, shift=(0.0, 0.0, 0.0)):
    return Mesh(scale * mesh.positions + np.asarray(shift), mesh.faces, mesh.normals)


def outward_rays(mesh, rng, per_vertex=20):
    """Rays into the upper hemisphere of each vertex, down to 1 degree above the horizon."""
    normals = np.repeat(mesh.normals, per_vertex, axis=0)
    directions = rng.normal(size=normals.shape)
    directions -= np.einsum("ij,ij->i", directions, normals)[:, None] * normals
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    height = np.tile(np.sin(np.radians(np.geomspace(1.0, 89.0, per_vertex))), mesh.n_vertices)
    directions = height[:, None] * normals + np.sqrt(1 - height**2)[:, None] * directions
    return np.repeat(mesh.positions, per_vertex, axis=0), normals, directions.astype(np.float32)


@pytest.mark.parametrize("scale", SCALES)
def test_epsilon_scales_with_the_scene(scale):
    bounds = np.array([[-1.0, 0, -1], [1, 2, 1]])
    assert ray_epsilon(scale * bounds) == pytest.approx(scale * ray_epsilon(bounds), rel=1e-12)
    # small beside the scene, large beside its rounding
    assert 1e-7 < ray_epsilon(bounds) / np.sqrt(12.0) < 1e-5


def test_epsilon_grows_with_the_distance_from_the_origin():
    near = np.array([[0.0] * 3, [1.0] * 3])
    assert ray_epsilon(near + 1e5) > 1e4 * ray_epsilon(near)
    step = np.spacing(np.float32(1e5))
    assert ray_epsilon(near + 1e5) > step


@pytest.mark.parametrize("scale", SCALES)
def test_convex_surface_never_shades_itself(rng, scale):
    mesh = scaled(sphere_mesh(3), scale)
    accelerator = Accelerator(mesh.positions, mesh.faces)
    points, normals, directions = outward_rays(mesh, rng)
    epsilon = ray_epsilon(mesh.bounds)
    moved = offset_origins(points, normals, epsilon)
    assert moved.dtype == np.float32
    assert not accelerator.occluded(moved, directions).any()
    # without the offset many would: that is what the offset is for
    saved = self_hit_count(accelerator, points, normals, directions, epsilon)
    bare = accelerator.occluded(points.astype(np.float32), directions)
    assert saved == np.count_nonzero(bare)
    assert saved > 0.1 * len(points)


@pytest.mark.parametrize("scale", SCALES)
def test_plane_never_shades_itself_at_grazing_angles(rng, scale):
    plane = scaled(grid_mesh(16, 16), scale, shift=(0.3 * scale, 0.7 * scale, -0.2 * scale))
    accelerator = Accelerator(plane.positions, plane.faces)
    points, normals, directions = outward_rays(plane, rng)
    moved = offset_origins(points, normals, ray_epsilon(plane.bounds))
    assert not accelerator.occluded(moved, directions).any()


def test_scene_far_from_the_origin_does_not_shade_itself(rng):
    mesh = scaled(sphere_mesh(2), 1.0, shift=(500.0, -300.0, 100.0))
    accelerator = Accelerator(mesh.positions, mesh.faces)
    points, normals, directions = outward_rays(mesh, rng)
    moved = offset_origins(points, normals, ray_epsilon(mesh.bounds))
    assert accelerator.occluded(moved, directions).mean() < 1e-3
    # an offset that looks at the diagonal alone is lost in the rounding of the coordinates
    diagonal_only = ray_epsilon(mesh.bounds - mesh.bounds.mean(axis=0))
    lost = offset_origins(points, normals, diagonal_only)
    assert accelerator.occluded(lost, directions).mean() > 0.05


@pytest.mark.parametrize("scale", SCALES)
def test_coincident_surfaces_facing_apart_see_past_each_other(scale):
    """The ceiling of the Cornell box and its light: one plane, facing up and facing down."""
    up = scaled(grid_mesh(2, 2), scale)
    positions = np.concatenate([up.positions, up.positions])
    faces = np.concatenate([up.faces, up.faces[:, ::-1] + up.n_vertices]).astype(np.int32)
    centres = positions[faces].mean(axis=1)
    normals = np.repeat([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], up.n_faces, axis=0)
    accelerator = Accelerator(positions, faces)
    bounds = np.stack([positions.min(axis=0), positions.max(axis=0)])
    moved = offset_origins(centres, normals, ray_epsilon(bounds))
    assert not accelerator.occluded(moved, normals.astype(np.float32)).any()
    # each blocks the other's back
    assert accelerator.occluded(moved, -normals.astype(np.float32)).all()


def test_real_occluders_stay():
    """The offset must not carry rays through what shades them: a lid 1e-4 diagonals above."""
    plane = grid_mesh(4, 4)
    lid = plane.positions + np.array([0.0, 1e-4, 0.0])
    positions = np.concatenate([plane.positions, lid])
    faces = np.concatenate([plane.faces, plane.faces + plane.n_vertices]).astype(np.int32)
    epsilon = ray_epsilon(np.stack([positions.min(axis=0), positions.max(axis=0)]))
    inner = np.abs(plane.positions).max(axis=1) < 0.4
    moved = offset_origins(plane.positions[inner], plane.normals[inner], epsilon)
    up = plane.normals[inner].astype(np.float32)
    accelerator = Accelerator(positions, faces, robust=True)
    assert accelerator.occluded(moved, up).all()
    through = offset_origins(plane.positions[inner], plane.normals[inner], 2e-4)
    assert not accelerator.occluded(through, up).any()


def room(scale, shift, n=4):
    """A closed cube seen from inside, of six squares that share no vertex."""
    parts = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            grid = grid_mesh(n, n)
            # y to the axis, turned so that the normal looks inwards
            turn = np.roll(np.eye(3), axis - 1, axis=0) * np.array([1.0, -sign, -sign])
            positions = (grid.positions - [0.0, 0.5, 0.0]) @ turn.T
            parts.append(Mesh(scale * positions + shift, grid.faces, grid.normals @ turn.T))
    return Scene.from_parts(parts)


@pytest.mark.parametrize("scale", SCALES)
def test_no_ray_leaves_a_room_of_separate_walls(rng, scale):
    scene = room(scale, scale * np.array([0.3, -0.7, 2.1]))
    middle = scene.positions.mean(axis=0)
    assert (((middle - scene.positions) * scene.normals).sum(axis=1) > 0.0).all()
    accelerator = Accelerator(scene.positions, scene.faces, robust=True)
    epsilon = ray_epsilon(scene.bounds)
    mesh = Mesh(scene.positions, scene.faces, scene.normals)
    _points, normals, directions = outward_rays(mesh, rng, per_vertex=100)

    def leaked(starts):
        origins = offset_origins(np.repeat(starts, 100, axis=0), normals, epsilon)
        return (~accelerator.occluded(origins, directions)).mean()

    assert leaked(scene.ray_points) == 0.0
    # the negative twin: a vertex in the plane of a wall starts on either side of it, by rounding;
    # at 1e4 units all coordinates are float32 numbers, and Embree counts a hit at distance 0
    assert (leaked(scene.positions) > 0.05) == (scale < 1e4)


def inset(positions, faces, normals):
    part = np.zeros(len(positions), np.int64)
    return inset_boundary(positions, faces, normals, part, 1e-3)


def test_only_open_edges_are_moved_and_inwards():
    grid = grid_mesh(6, 6)
    moved = inset(grid.positions, grid.faces, grid.normals)
    way = moved - grid.positions
    edge = (np.abs(grid.positions[:, [0, 2]]) == 0.5).any(axis=1)
    assert np.linalg.norm(way[edge], axis=1) == pytest.approx(1e-3, rel=1e-9)
    assert not way[~edge].any()
    assert (np.abs(moved[edge][:, [0, 2]]).max(axis=1) < 0.5).all()
    assert not way[:, 1].any()
    ball = sphere_mesh(2)
    closed = inset(ball.positions, ball.faces, ball.normals)
    assert closed.tobytes() == ball.positions.tobytes()


def test_the_rim_of_a_dome_is_not_moved_into_it():
    """A vertex on a convex rim moves along its tangent plane, not down to the chord."""
    ball = sphere_mesh(3)
    centred = ball.positions - [0.0, 1.0, 0.0]
    dome = ball.faces[(centred[ball.faces][:, :, 1] >= -1e-9).all(axis=1)]
    moved = inset(centred, dome, ball.normals) - centred
    height = (moved * ball.normals).sum(axis=1)
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(1e-3, rel=1e-9)
    assert height.min() > -1e-12
    assert INSET < 1.0


CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
OUTWARD = np.array(
    [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
     [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
)  # fmt: skip


def box(*, inward=False, positions=CORNERS, crease_angle_deg=30.0):
    faces = OUTWARD[:, ::-1] if inward else OUTWARD
    raw = RawMesh(positions, np.ascontiguousarray(faces))
    return repair(raw, "test", orient_outward=False, crease_angle_deg=crease_angle_deg)[0]


def sides_of(mesh):
    return ray_sides(mesh.positions, mesh.faces, mesh.normals, np.zeros(mesh.n_vertices, np.int64))


@pytest.mark.parametrize("inward", [False, True])
def test_the_sides_of_a_split_corner_lie_between_its_normals(inward):
    mesh = box(inward=inward)
    diagonals = (2.0 * mesh.positions - 1.0) / np.sqrt(3.0)
    assert sides_of(mesh) == pytest.approx(-diagonals if inward else diagonals, abs=1e-15)
    # what the normal would be without the split
    smooth = box(inward=inward, crease_angle_deg=180.0)
    place = (mesh.positions[:, None] == smooth.positions).all(axis=2).argmax(axis=1)
    assert sides_of(mesh) == pytest.approx(smooth.normals[place], abs=1e-15)


@pytest.mark.parametrize("mesh", [sphere_mesh(2), teapot(4)], ids=["sphere", "teapot"])
def test_without_a_split_the_sides_are_the_normals_to_the_last_bit(mesh):
    """In the teapot handle and body touch at one point, by no edge: each keeps its own."""
    assert sides_of(mesh).tobytes() == mesh.normals.tobytes()


def test_a_uv_seam_is_no_split():
    """Vertices that differ in UV alone share their normal, and so their side, to the last bit."""
    mesh = sphere_mesh(1)
    faces = mesh.faces + np.int32(mesh.n_vertices) * (np.arange(mesh.n_faces)[:, None] % 2 == 0)
    doubled = Mesh(
        np.tile(mesh.positions, (2, 1)), faces.astype(np.int32), np.tile(mesh.normals, (2, 1))
    )
    assert sides_of(doubled).tobytes() == doubled.normals.tobytes()


def test_parts_that_touch_keep_their_own_sides():
    """A box on a plane whose vertices it meets: the plane's rays leave upwards."""
    mesh, plane = box(), grid_mesh(2, 2)
    plane = Mesh(plane.positions + np.array([0.5, 0.0, 0.5]), plane.faces, plane.normals)
    scene = Scene.from_parts([mesh, plane])
    assert (scene.ray_sides[24:] == [0.0, 1.0, 0.0]).all()
    assert (scene.ray_sides[:24] == sides_of(mesh)).all()


def test_a_sheet_of_two_sides_keeps_its_normals():
    """Front and back face each other's ways: there is no direction between them."""
    up = grid_mesh(2, 2)
    positions = np.tile(up.positions, (2, 1))
    faces = np.concatenate([up.faces, up.faces[:, ::-1] + up.n_vertices]).astype(np.int32)
    normals = np.repeat([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]], up.n_vertices, axis=0)
    assert (sides_of(Mesh(positions, faces, normals)) == normals).all()


@pytest.mark.parametrize("scale", SCALES)
def test_no_light_leaks_into_a_closed_room_of_flat_walls(rng, scale):
    """Floor, walls and ceiling meet at vertices split three ways; every ray must end at a wall."""
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    for positions in (CORNERS, CORNERS @ turn):
        inward = np.linalg.det(turn) > 0.0 or positions is CORNERS
        room = box(inward=inward, positions=scale * (positions + 0.3))
        accelerator = Accelerator(room.positions, room.faces, robust=True)
        points, normals, directions = outward_rays(room, rng, per_vertex=300)
        epsilon = ray_epsilon(room.bounds)
        sides = np.repeat(sides_of(room), 300, axis=0)
        assert accelerator.occluded(offset_origins(points, sides, epsilon), directions).all()
        # along its own normal a ray starts in the planes of the walls, and passes some of them
        passing = ~accelerator.occluded(offset_origins(points, normals, epsilon), directions)
        assert positions is CORNERS or passing.mean() > 0.05


@pytest.mark.parametrize("scale", SCALES)
def test_a_box_of_flat_sides_never_shades_itself(rng, scale):
    mesh = box(positions=scale * (CORNERS + 0.3))
    accelerator = Accelerator(mesh.positions, mesh.faces)
    points, _, directions = outward_rays(mesh, rng, per_vertex=100)
    sides = np.repeat(sides_of(mesh), 100, axis=0)
    assert not accelerator.occluded(
        offset_origins(points, sides, ray_epsilon(mesh.bounds)), directions
    ).any()
