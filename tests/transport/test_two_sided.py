"""Light on both sides of a sheet: closed forms, and paths over the sheet as it was given."""

import numpy as np
import pytest

from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.environment.procedural import constant
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.primitives import grid_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.sides import both_sides
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
from support.bounce_scenes import bowl, disc, opaque, patch, turned_inside_out

CUBE = cube_directions(12)
BASIS = SrbfBasis(icosphere(2))
PROJECTION = BASIS.projection(CUBE.directions, CUBE.weights)
WHITE = factorise(Lambert(np.array([1.0])))


def bake(scene, factorisation=WHITE, vertex_range=None):
    return bake_block(
        scene, Accelerator(scene.positions, scene.traced_faces),
        vertex_range or (0, scene.n_vertices),
        factorisation=factorisation, projection=PROJECTION, directions=CUBE,
    ).coefficients  # fmt: skip


def bounced(scene, albedos, n_bounces, n_rays=256):
    """What vertices send over their albedo under radiance 1, by the stages of a job."""
    surface, n_parts = opaque(scene), len(albedos)
    sizes = [stop - start for start, stop in scene.part_ranges]
    values = np.repeat(np.array(albedos, np.float64), sizes)[:, None]
    albedo = Albedo.of_vertices(scene.faces, values)
    escaped = build_bounce_block(
        surface, (0, scene.n_vertices), albedo=albedo, n_rays=n_rays, seed=3
    ).escaped
    direct = [
        escaped[start:stop, None, None].astype(np.float32) for start, stop in scene.part_ranges
    ]
    found = bounce_block(
        surface, direct, factorisations=[WHITE] * n_parts, albedo=albedo, n_channels=1,
        n_rays=[n_rays] * n_parts, seed=3, max_bounces=n_bounces, tolerance=0.0,
    )  # fmt: skip
    return [
        (one + added[:, 0])[:, 0, 0] for one, added in zip(direct, found.added, strict=True)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def sheet():
    """A plane with both sides."""
    return Scene.from_parts([both_sides(grid_mesh(6, 6))], two_sided=(True,))


@pytest.mark.parametrize("inward", [False, True])
def test_rays_meet_the_copy_of_the_side_that_they_come_from(rng, inward):
    surface = bowl(6, 16, depth_rad=1.2)
    given = turned_inside_out(surface) if inward else surface
    scene = Scene.from_parts([both_sides(given)], two_sided=(True,))
    at = rng.uniform(-0.5, 0.5, (4000, 2))
    above = np.arange(4000) % 2 == 0
    origins = np.stack([at[:, 0], np.where(above, 3.0, -3.0), at[:, 1]], axis=1)
    directions = np.stack([np.zeros(4000), np.where(above, -1.0, 1.0), np.zeros(4000)], axis=1)
    origins, directions = origins.astype(np.float32), directions.astype(np.float32)
    hits = opaque(scene).intersect(origins, directions)
    assert len(hits.rays) == 4000
    assert hits.front.all()
    normals = scene.normals[scene.faces[hits.triangles]]
    assert ((normals[..., 1] > 0.0) == above[hits.rays][:, None]).all()
    # the barycentrics are those of the copy
    points = np.einsum(
        "hc,hci->hi", hits.barycentrics, scene.positions[scene.faces[hits.triangles]]
    )
    np.testing.assert_allclose(points[:, [0, 2]], origins[hits.rays][:, [0, 2]], atol=2e-6)
    # the negative twin: a sheet with one side shows its back to half of the rays
    alone = opaque(Scene.from_parts([given])).intersect(origins, directions)
    assert alone.front.mean() == 0.5


def test_both_sides_of_a_plane_have_the_closed_form(sheet):
    """Nothing is in the way: T = max(0, n . w) / pi, n up for one copy and down for the other."""
    n = sheet.n_vertices // 2
    found = bake(sheet)[:, 0]
    for part, up in ((slice(0, n), 1.0), (slice(n, 2 * n), -1.0)):
        samples = np.maximum(0.0, up * CUBE.directions[:, 1]) / np.pi
        expected = samples @ PROJECTION.matrix
        # float32 sums; directions in the plane itself are seen from neither side
        assert np.abs(found[part] - expected).max() < 1e-5 * np.abs(expected).max()
    # the copy below is lit by what lights the plane from below, and by nothing else
    assert np.abs(found[:n] - found[n:]).max() > 0.5 * np.abs(found).max()


@pytest.mark.parametrize("glossy", [False, True])
def test_a_copy_has_the_transfer_of_a_sheet_that_faces_its_side(glossy):
    """Bit for bit, above and below; so the front of a two-sided part is that of one with one."""
    brdf = CookTorrance(np.array([0.3]), np.array([0.7]), 0.5, np.array([0.1]))
    factorisation = factorise(brdf, n_terms=4, n_theta=12, n_phi=32) if glossy else WHITE
    surface = bowl(4, 12)
    scene, n = Scene.from_parts([both_sides(surface)], two_sided=(True,)), surface.n_vertices
    # as many vertices at a time: products of other sizes are rounded otherwise
    inside, outside = (
        bake(scene, factorisation, vertex_range) for vertex_range in ((0, n), (n, 2 * n))
    )
    for own, mesh in ((inside, surface), (outside, turned_inside_out(surface))):
        assert (own == bake(Scene.from_parts([mesh]), factorisation)).all()
    # the inside is shadowed, the outside is not
    assert (inside**2).sum() < 0.8 * (outside**2).sum()


def test_inside_and_outside_of_a_bowl():
    """Inside a white furnace, X = 1 - s^(B+1) with s = 1/2; outside nothing but the sky."""
    outside = turned_inside_out(bowl(12, 32))
    scene = Scene.from_parts([both_sides(outside)], two_sided=(True,))
    (found,) = bounced(scene, [1.0], 3)
    n = outside.n_vertices
    areas = scene.areas[:n] / scene.areas[:n].sum()
    # the polyhedron is a little flatter than the sphere
    assert areas @ found[n:] == pytest.approx(1.0 - 0.5**4, abs=4e-3)
    assert found[:n] == pytest.approx(1.0, abs=1e-5)
    # the negative twin: with one side, the inside is black and nobody can ask for more
    (alone,) = bounced(Scene.from_parts([outside]), [1.0], 3)
    assert (alone == found[:n]).all()


@pytest.fixture(scope="module")
def gap():
    """A floor and a sheet above it that faces up: its underside is all that the floor sees of it."""
    floor = patch([-1, 0, 1], [2, 0, 0], [0, 0, -2], 16, 16)
    above = disc(1.0, 0.5, 12, 24, up=True)
    return floor, above


def test_two_bounces_between_a_sheet_and_a_floor_are_those_of_paths(gap):
    """Paths run over the sheet as it is given, once, and turn it over where they meet its back."""
    floor, above = gap
    albedos = [0.7, 0.8]
    scene = Scene.from_parts([floor, both_sides(above)], two_sided=(False, True))
    of_floor, of_sheet = bounced(scene, albedos, 2)
    plain = Scene.from_parts([floor, above])
    brdfs = [Lambert(np.array([albedo])) for albedo in albedos]
    materials = [PathMaterial(brdfs[0]), PathMaterial(brdfs[1], two_sided=True)]

    def traced(scene, materials, vertices, n_bounces=2):
        points = PathPoints.of_vertices(scene, vertices, scene.normals[vertices])
        estimate = trace_paths(
            opaque(scene), materials, points, constant(16), np.eye(3),
            n_bounces=n_bounces, n_passes=8, n_samples=64, seed=5,
        )  # fmt: skip
        return estimate.mean[:, 0], estimate.variance[:, 0]

    def agree(found, mean, variance, slack):
        # 256 rays a vertex: the bounces' own noise is below that of 512 paths a vertex
        error = np.sqrt(2.0 * variance.mean() / len(mean))
        assert abs((found - mean).mean()) < 4.0 * error + slack
        assert np.sqrt(((found - mean) ** 2).mean()) < 3.0 * np.sqrt(variance.mean()) + slack

    seen = np.arange(0, floor.n_vertices, 5)
    mean, variance = traced(plain, materials, seen)
    # bounces mix the corners' radiance: 2.9e-3 at cells twice as wide, 1.0e-3 here,
    # 0.3e-3 at half as wide
    slack = 2e-3
    agree(0.7 * of_floor[seen], mean, variance, slack)
    # the underside: paths of the same single sheet cannot start there, those of the copies can
    n, start = above.n_vertices, scene.part_ranges[1][0]
    below = np.arange(start + n, start + 2 * n, 5)
    mean, variance = traced(scene, [PathMaterial(brdf) for brdf in brdfs], below)
    agree(0.8 * of_sheet[n::5], mean, variance, slack)
    # and they agree on the floor with those of the single sheet
    again, other = traced(scene, [PathMaterial(brdf) for brdf in brdfs], seen)
    mean, variance = traced(plain, materials, seen)
    assert abs((again - mean).mean()) < 4.0 * np.sqrt((variance + other).mean() / len(seen))
    # the negative twin: an underside that is black, far outside of that
    one, _ = bounced(plain, albedos, 2)
    assert 0.7 * (of_floor - one).mean() > 20.0 * slack


def test_a_sheet_beside_one_with_one_side_in_one_place():
    """Two sheets in one plane: what is seen of either side is a front, of whichever of the two."""
    lower = turned_inside_out(grid_mesh(3, 3))
    scene = Scene.from_parts([lower, both_sides(grid_mesh(4, 4))], two_sided=(False, True))
    rng = np.random.default_rng(2)
    at = rng.uniform(-0.45, 0.45, (500, 2))
    for up in (1.0, -1.0):
        origins = np.stack([at[:, 0], np.full(500, up), at[:, 1]], axis=1).astype(np.float32)
        directions = np.tile(np.array([0.0, -up, 0.0], np.float32), (500, 1))
        hits = opaque(scene).intersect(origins, directions)
        assert hits.front.all()
        assert (scene.normals[scene.faces[hits.triangles, 0], 1] == up).all()
