"""Embree behind the accelerator, against the plain twin."""

import numpy as np
import pytest

from prtbake_workers.geometry.accelerator import RAYS_PER_CALL, Accelerator
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.teapot import teapot
from support.brute_force import BruteForce

SCALES = [1e-4, 1.0, 1e4]


def soup(rng, n=60):
    """Triangles of all sizes in a unit cube."""
    corners = rng.random((n, 1, 3)) + 0.3 * rng.normal(size=(n, 3, 3)) * rng.random((n, 1, 1))
    return corners.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3)


def rays_through(rng, bounds, n):
    origins = bounds[0] + rng.random((n, 3)) * (bounds[1] - bounds[0])
    directions = rng.normal(size=(n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return origins.astype(np.float32), directions.astype(np.float32)


def edge_distance(hits):
    """How far, in barycentrics, the hit lies from the nearest edge."""
    return hits.barycentrics.min(axis=1)


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("scale", SCALES)
def test_agrees_with_brute_force(rng, scale, robust):
    positions, faces = soup(rng)
    positions = scale * positions
    bounds = np.stack([positions.min(axis=0), positions.max(axis=0)])
    origins, directions = rays_through(rng, bounds, 3000)
    fast = Accelerator(positions, faces, robust=robust).intersect(origins, directions)
    plain = BruteForce(positions, faces).intersect(origins, directions)
    # rays within float32 of an edge may go either way: they are few, and the rest must agree
    same = fast.triangles == plain.triangles
    assert same.mean() > 0.999
    hit = same & (fast.triangles >= 0)
    assert 0.1 < hit.mean() < 0.9
    size = np.linalg.norm(bounds[1] - bounds[0])
    # positions, origins and Embree's arithmetic are float32: some 1e-6 of the scene, and more for
    # rays that graze their triangle (measured 2e-5)
    assert np.abs(fast.distance[hit] - plain.distance[hit]).max() < 1e-4 * size
    middling = hit & (edge_distance(plain) > 0.01)
    assert np.abs(fast.barycentrics - plain.barycentrics)[middling].max() < 5e-3
    # and the barycentrics give the point of the hit
    points = np.einsum("rc,rci->ri", fast.barycentrics, positions[faces[fast.triangles]])
    along = origins + fast.distance[:, None] * directions
    assert np.abs(points - along)[hit].max() < 1e-4 * size


def test_swapped_barycentrics_would_be_found(rng):
    positions, faces = soup(rng)
    origins, directions = rays_through(rng, np.array([[0.0] * 3, [1.0] * 3]), 500)
    hits = Accelerator(positions, faces).intersect(origins, directions)
    hit = hits.triangles >= 0
    swapped = hits.barycentrics[:, [0, 2, 1]]
    points = np.einsum("rc,rci->ri", swapped, positions[faces[hits.triangles]])
    along = origins + hits.distance[:, None] * directions
    assert np.abs(points - along)[hit].max() > 0.05


def test_misses_are_marked():
    mesh = sphere_mesh(1)
    origins = np.array([[0, 5, 0], [0, 5, 0]], np.float32)
    directions = np.array([[0, 1, 0], [0, -1, 0]], np.float32)
    for tracer in (Accelerator, BruteForce):
        hits = tracer(mesh.positions, mesh.faces).intersect(origins, directions)
        assert hits.triangles[0] == -1
        assert np.isinf(hits.distance[0])
        assert (hits.barycentrics[0] == 0.0).all()
        assert hits.triangles[1] >= 0
        assert hits.barycentrics[1].sum() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("scale", SCALES)
def test_occlusion_is_that_some_triangle_is_hit(rng, scale):
    positions, faces = soup(rng)
    positions = scale * positions
    origins, directions = rays_through(rng, scale * np.array([[0.0] * 3, [1.0] * 3]), 3000)
    fast = Accelerator(positions, faces)
    assert (
        fast.occluded(origins, directions) == (fast.intersect(origins, directions).triangles >= 0)
    ).all()
    plain = BruteForce(positions, faces).occluded(origins, directions)
    assert (fast.occluded(origins, directions) == plain).mean() > 0.999


def test_the_same_scene_at_every_scale_gives_the_same_hits(rng):
    mesh = teapot(6)
    origins, directions = rays_through(rng, mesh.bounds, 20_000)
    reference = Accelerator(mesh.positions, mesh.faces).intersect(origins, directions)
    for scale in (1e-4, 1e4):
        scaled = Accelerator(scale * mesh.positions, mesh.faces).intersect(
            (scale * origins.astype(np.float64)).astype(np.float32), directions
        )
        # the scaled coordinates round differently: rays within that of an edge may change
        assert (scaled.triangles == reference.triangles).mean() > 0.9995
        both = (scaled.triangles == reference.triangles) & (reference.triangles >= 0)
        ratio = scaled.distance[both] / (scale * reference.distance[both])
        assert np.median(np.abs(ratio - 1.0)) < 1e-6
    # powers of two round alike: every bit is the same
    doubled = Accelerator(1024.0 * mesh.positions, mesh.faces).intersect(1024 * origins, directions)
    assert (doubled.triangles == reference.triangles).all()
    assert (doubled.barycentrics == reference.barycentrics).all()


def test_far_from_the_origin_the_scene_keeps_its_shape(rng):
    """Coordinates around 1e4 keep 3 digits of a unit scene; the triangles stay what they are."""
    mesh = teapot(6)
    shift = np.array([1e4, -1e4, 1e4])
    positions = (mesh.positions + shift).astype(np.float32).astype(np.float64)
    origins, directions = rays_through(rng, mesh.bounds + shift, 500)
    moved = Accelerator(positions, mesh.faces).intersect(origins, directions)
    plain = BruteForce(positions, mesh.faces).intersect(origins, directions)
    assert (moved.triangles == plain.triangles).mean() > 0.995
    seen = (plain.triangles >= 0) & (moved.triangles == plain.triangles)
    assert seen.mean() > 0.3
    # from here on it is a scene like any other: no trace of the 1e4 is left in the distance
    assert np.abs(moved.distance[seen] - plain.distance[seen]).max() < 1e-4


def test_grazing_rays_miss_the_plane_they_run_along():
    plane = grid_mesh(4, 4)
    origins = np.array([[-2.0, 1e-5, 0.01], [-2.0, -1e-5, 0.01]], np.float32)
    along = np.array([[1.0, 0.0, 0.0]] * 2, np.float32)
    assert not Accelerator(plane.positions, plane.faces).occluded(origins, along).any()
    # tilted by 5e-6 towards the plane they meet it in its middle
    tilted = np.array([[1.0, -5e-6, 0.0], [1.0, 5e-6, 0.0]], np.float32)
    hits = Accelerator(plane.positions, plane.faces).intersect(origins, tilted)
    assert (hits.triangles >= 0).all()
    # the height is off by float32 of the scene, 1e-7, over a slope of 5e-6
    assert hits.distance == pytest.approx([2.0, 2.0], abs=0.05)


def test_coincident_triangles_are_one_surface():
    """Two equal squares in one plane: one of them is hit, at the right distance."""
    grid = grid_mesh(2, 2)
    positions = np.concatenate([grid.positions, grid.positions])
    faces = np.concatenate([grid.faces, grid.faces[:, ::-1] + grid.n_vertices])
    origins = np.array([[0.1, 1.0, 0.2], [0.1, -1.0, 0.2]], np.float32)
    directions = np.array([[0, -1, 0], [0, 1, 0]], np.float32)
    hits = Accelerator(positions, faces.astype(np.int32)).intersect(origins, directions)
    assert (hits.triangles >= 0).all()
    assert hits.distance == pytest.approx([1.0, 1.0], abs=1e-6)


def test_robust_scenes_do_not_leak_at_edges(rng):
    """From inside a closed surface, at its very edges."""
    mesh = sphere_mesh(3)
    centre = np.array([0.05, 1.02, -0.03])
    edges = mesh.faces[:, [0, 1]]
    weight = rng.random((len(edges), 1))
    targets = weight * mesh.positions[edges[:, 0]] + (1 - weight) * mesh.positions[edges[:, 1]]
    rays = targets - centre
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origins = np.tile(centre, (len(rays), 1)).astype(np.float32)
    robust = Accelerator(mesh.positions, mesh.faces, robust=True)
    assert robust.occluded(origins, rays.astype(np.float32)).all()
    # and what the fast test lets through is little: 0 to 2 % of rays aimed at edges
    fast = Accelerator(mesh.positions, mesh.faces)
    assert fast.occluded(origins, rays.astype(np.float32)).mean() > 0.95


def test_more_rays_than_one_block(rng):
    mesh = sphere_mesh(1)
    n = RAYS_PER_CALL + 17
    origins, directions = rays_through(rng, 2.0 * mesh.bounds, n)
    accelerator = Accelerator(mesh.positions, mesh.faces)
    all_at_once = accelerator.occluded(origins, directions)
    tail = slice(RAYS_PER_CALL - 5, None)
    assert (all_at_once[tail] == accelerator.occluded(origins[tail], directions[tail])).all()
    hits = accelerator.intersect(origins, directions)
    assert ((hits.triangles >= 0) == all_at_once).all()


def test_no_rays():
    mesh = sphere_mesh(0)
    none = np.zeros((0, 3), np.float32)
    accelerator = Accelerator(mesh.positions, mesh.faces)
    assert accelerator.occluded(none, none).shape == (0,)
    assert accelerator.intersect(none, none).barycentrics.shape == (0, 3)


def test_rays_that_are_not_numbers_hit_nothing():
    mesh = sphere_mesh(0)
    bad = np.full((1, 3), np.nan, np.float32)
    up = np.array([[0.0, 1.0, 0.0]], np.float32)
    accelerator = Accelerator(mesh.positions, mesh.faces)
    assert not accelerator.occluded(bad, up)[0]
    assert not accelerator.occluded(np.zeros((1, 3), np.float32), bad)[0]


def test_a_scene_without_extent_is_refused():
    with pytest.raises(ValueError, match="cannot be traced"):
        Accelerator(np.zeros((3, 3)), np.array([[0, 1, 2]], np.int32))
