"""The path tracer against the direct reference, quadrature, the bounce operator and itself."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.phong import Phong
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.procedural import constant, one_texel_sun
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.environment.subdivision import subdivided_texels
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport import path_material
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.interreflection import bounce_series
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
from prtbake_workers.transport.proposal import Proposal
from prtbake_workers.transport.reference import blocks, to_local, visible_cosine
from prtbake_workers.validation.light import draw_pass
from support.bounce_scenes import ball, disc, opaque, patch, turned_inside_out

ROTATION = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
GLOSSY = CookTorrance(np.array([0.3]), np.array([0.7]), 0.3, np.array([0.1]))
COLOURED = Lambert(np.array([0.8, 0.4, 0.1]))


def uneven(height=16):
    """A sky of all colours with a bright spot."""
    rng = np.random.default_rng(8)
    radiance = rng.uniform(0.1, 1.0, (height, 2 * height, 3)).astype(np.float32)
    radiance[height // 4, height // 3] = 30.0
    return Environment(radiance)


@pytest.fixture(scope="module")
def nook():
    """A floor, a wall and a ball between them."""
    floor = patch([-1, 0, 1], [2, 0, 0], [0, 0, -2], 6, 6)
    wall = patch([-1, 0, -1], [2, 0, 0], [0, 1.5, 0], 5, 4)
    return Scene.from_parts([floor, wall, ball(2, (0.1, 0.5, 0.0), 0.4)])


def materials(*brdfs, **options):
    return [PathMaterial(brdf, **options) for brdf in brdfs]


NOOK_MATERIALS = materials(Lambert(np.array([0.6])), COLOURED, GLOSSY)


def seen_points(scene, n=60):
    """Points all over the scene, each seen from its front."""
    rng = np.random.default_rng(5)
    triangles = rng.choice(scene.n_faces, n, replace=False).astype(np.int64)
    barycentrics = rng.dirichlet([1.0, 1.0, 1.0], n)
    across = scene.normals[scene.faces[triangles]].mean(axis=1)
    wo = across + 0.9 * rng.normal(size=(n, 3))
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    points, front = PathPoints.seen(scene, triangles, barycentrics, wo, np.zeros(n, np.bool_))
    return points.pick(np.flatnonzero(front))


def trace(scene, parts, points, light, **options):
    options = {"n_bounces": 1, "n_passes": 8, "n_samples": 64, "seed": 1} | options
    rotation = options.pop("rotation", np.eye(3))
    return trace_paths(opaque(scene), parts, points, light, rotation, **options)


def assert_same_expectation(one, other, slack=0.0):
    """Two estimates of one thing: 8 to 20 passes each, hence the wide 6 standard errors."""
    error = np.sqrt(one.variance + other.variance)
    difference = one.mean - other.mean
    assert (np.abs(difference) <= 6.0 * error + slack + 1e-12).all()
    total = np.sqrt((error**2).sum()) / error.size
    # the three channels of a path move together
    assert abs(difference.mean()) <= 4.0 * np.sqrt(3.0) * total + slack


class DirectReference:
    """What the validation renders: shared light samples, all visible ones summed."""

    def __init__(self, scene, parts, points, light, n_passes, n_samples):
        accelerator = Accelerator(scene.positions, scene.faces, robust=True)
        rng, sampler = np.random.default_rng(9), EnvironmentSampler(light)
        passes = np.zeros((n_passes, len(points), 3))
        part_of = scene.part_of_face[points.triangles]
        for index in range(n_passes):
            drawn = draw_pass(sampler, ROTATION, n_samples, rng)
            for part, material in enumerate(parts):
                own = np.flatnonzero(part_of == part)
                received = visible_cosine(
                    points.surface.block(own), drawn.directions, accelerator,
                    ray_epsilon(scene.bounds),
                )  # fmt: skip
                frames = points.frames[own]
                wi = to_local(frames, drawn.directions)
                wo = np.einsum("pij,pj->pi", frames, points.wo[own])
                rho = material.brdf.eval_brdf(wi, wo[:, None, :])
                passes[index, own] = np.einsum("ps,psc,sc->pc", received, rho, drawn.weights)
        self.mean = passes.mean(axis=0)
        self.variance = passes.var(axis=0, ddof=1) / n_passes


def test_without_bounces_it_is_the_direct_reference(nook):
    points, light = seen_points(nook), uneven()
    found = trace(nook, NOOK_MATERIALS, points, light, n_bounces=0, n_passes=16, rotation=ROTATION)
    reference = DirectReference(nook, NOOK_MATERIALS, points, light, 16, 2000)
    assert_same_expectation(found, reference)
    assert found.by_bounce[0] == pytest.approx(found.mean, rel=1e-12)
    # the negative twins: one bounce more, and the light not turned
    more = trace(nook, NOOK_MATERIALS, points, light, n_passes=16, rotation=ROTATION)
    assert (more.mean - reference.mean).mean() > 0.05 * reference.mean.mean()
    unturned = trace(nook, NOOK_MATERIALS, points, light, n_bounces=0, n_passes=16)
    with pytest.raises(AssertionError):
        assert_same_expectation(unturned, reference)


@pytest.mark.parametrize(
    "brdf",
    [
        COLOURED,
        GLOSSY,
        Phong(np.array([0.1]), np.array([0.8]), 300.0),
        CookTorrance(np.array([0.0]), np.array([1.0]), 0.05, np.array([0.9])),
    ],
    ids=["lambert", "rough", "phong 300", "m 0.05"],
)
@pytest.mark.parametrize("light", [one_texel_sun(32), uneven()], ids=["sun", "uneven"])
def test_direct_light_equals_quadrature(brdf, light):
    """Every combination of sharp and soft light and lobe, on an open plane."""
    scene = Scene.from_parts([patch([-1, 0, 1], [2, 0, 0], [0, 0, -2], 1, 1)])
    n = 12
    azimuth, height = np.linspace(0.0, 6.0, n), np.linspace(0.2, 0.97, n)
    wo = np.stack([np.sqrt(1 - height**2) * np.cos(azimuth), height,
                   np.sqrt(1 - height**2) * np.sin(azimuth)], axis=1)  # fmt: skip
    points, _ = PathPoints.seen(
        scene, np.zeros(n, np.int64), np.full((n, 3), 1 / 3), wo, np.zeros(n, np.bool_)
    )
    found = trace(scene, materials(brdf), points, light, n_bounces=0, n_passes=16, n_samples=256)
    directions, solid_angles, radiance = subdivided_texels(light, 0.012)
    wi = to_local(points.frames, directions)
    local = np.einsum("pij,pj->pi", points.frames, wo)
    expected = np.stack(
        [
            (brdf.eval_brdf(wi[p], local[p][None]) * np.maximum(wi[p, :, 2:], 0.0) * radiance
             * solid_angles[:, None]).sum(axis=0)
            for p in range(n)
        ]
    )  # fmt: skip
    error = np.sqrt(found.variance)
    # the quadrature's texels are 0.012 rad wide: 2e-3 at the sharpest lobe
    assert (np.abs(found.mean - expected) < 6.0 * error + 3e-3 * expected).all()
    # both samplings together leave no combination noisy: 4096 paths, 1.5 % was measured at worst
    assert (error < 0.03 * expected + 3e-4).all()


def test_any_proposal_has_the_same_expectation(nook, monkeypatch):
    points, light = seen_points(nook), uneven()
    brdfs = [material.brdf for material in NOOK_MATERIALS]
    options = {"n_bounces": 3, "n_passes": 8}
    fitted = trace(nook, NOOK_MATERIALS, points, light, **options)
    monkeypatch.setattr(path_material, "fit_proposal", lambda brdf: Proposal(0.5, 0.2))
    other = trace(nook, materials(*brdfs), points, light, **options, seed=2)
    assert_same_expectation(fitted, other)
    # the negative twin: a density that is 10 % too large
    monkeypatch.setattr(path_material, "fit_proposal", lambda brdf: TooLarge(0.5, 0.2))
    with pytest.raises(AssertionError):
        assert_same_expectation(
            fitted, trace(nook, materials(*brdfs), points, light, **options, seed=2)
        )


class TooLarge(Proposal):
    """A proposal whose density is not that of its samples."""

    def pdf(self, wi, wo):
        return 1.1 * super().pdf(wi, wo)


def test_diffuse_paths_equal_the_bounce_operator(nook):
    albedos = np.array([[0.6, 0.6, 0.6], [0.8, 0.4, 0.1], [0.3, 0.5, 0.7]])
    parts = materials(*(Lambert(albedo) for albedo in albedos))
    of_vertex = np.repeat(albedos, [stop - start for start, stop in nook.part_ranges], axis=0)
    block = build_bounce_block(
        opaque(nook), (0, nook.n_vertices),
        albedo=Albedo.of_vertices(nook.faces, of_vertex), n_rays=1024, seed=3,
    )  # fmt: skip
    series = bounce_series(
        block.escaped.astype(np.float32)[:, None], block.matrices, areas=nook.areas,
        tolerance=0.0, max_bounces=3,
    )  # fmt: skip
    vertices = np.arange(0, nook.n_vertices, 5)
    points = PathPoints.of_vertices(nook, vertices, nook.normals[vertices])
    found = trace(nook, parts, points, constant(16), n_bounces=3, n_samples=256)
    expected = series.transfer[:, vertices, 0].T * of_vertex[vertices]
    wrong = found.mean - expected
    # 1024 rays of the operator, and its linear interpolation over a floor of 6 x 6 cells with a
    # shadow on it: 4.1e-3 root mean square, 0.9e-3 bias were measured
    assert np.sqrt((wrong**2).mean()) < 6e-3
    assert abs(wrong.mean()) < 2e-3
    assert np.abs(found.by_bounce[1:].sum(axis=0)).mean() > 0.05


def test_the_seed_decides_and_blocks_do_not(nook, monkeypatch):
    points, light = seen_points(nook), uneven()
    options = {"n_bounces": 2, "n_passes": 2, "n_samples": 16}
    first = trace(nook, NOOK_MATERIALS, points, light, **options)
    again = trace(nook, NOOK_MATERIALS, points, light, **options)
    assert first.passes.tobytes() == again.passes.tobytes()
    monkeypatch.setattr("prtbake_workers.transport.reference.RAYS_PER_BLOCK", 16 * 20)
    assert len(list(blocks(len(points), 16))) > 1
    cut = trace(nook, NOOK_MATERIALS, points, light, **options)
    np.testing.assert_allclose(cut.passes, first.passes, rtol=1e-12)
    other = trace(nook, NOOK_MATERIALS, points, light, **options | {"seed": 2})
    assert (first.passes != other.passes).any(axis=2).mean() > 0.9
    assert (first.passes[0] != first.passes[1]).any(axis=1).mean() > 0.9


def test_bounces_add_up(nook):
    points, light = seen_points(nook), uneven()
    found = trace(nook, NOOK_MATERIALS, points, light, n_bounces=4)
    assert found.by_bounce.shape == (5, len(points), 3)
    assert found.by_bounce.sum(axis=0) == pytest.approx(found.mean, rel=1e-12)
    energy = found.by_bounce.mean(axis=(1, 2))
    assert (np.diff(energy) < 0.0).all()
    assert energy[4] > 0.0
    # the paths of fewer bounces are the same paths
    fewer = trace(nook, NOOK_MATERIALS, points, light, n_bounces=2)
    np.testing.assert_allclose(fewer.by_bounce, found.by_bounce[:3], rtol=1e-12, atol=1e-15)


def test_indirect_light_is_the_total_less_the_direct(nook):
    points, light = seen_points(nook), uneven()
    options = {"n_bounces": 4, "n_passes": 12, "rotation": ROTATION}
    found = trace(nook, NOOK_MATERIALS, points, light, **options)
    direct = trace(nook, NOOK_MATERIALS, points, light, **options | {"n_bounces": 0}, seed=7)
    apart = replace(found, passes=found.passes - direct.passes)
    inner = replace(found, passes=found.indirect)
    assert_same_expectation(apart, inner)
    assert found.indirect.mean(axis=0) == pytest.approx(found.by_bounce[1:].sum(axis=0), rel=1e-12)
    # the negative twin: the first bounce counted as direct
    with pytest.raises(AssertionError):
        assert_same_expectation(apart, replace(inner, passes=found.indirect - found.by_bounce[1]))
    # without the rays towards the light at the points it is the same indirect light
    alone = trace(nook, NOOK_MATERIALS, points, light, **options, indirect_only=True)
    np.testing.assert_allclose(alone.indirect, found.indirect, rtol=1e-12)
    assert alone.passes.tobytes() == alone.indirect.tobytes()
    assert not alone.by_bounce[0].any()
    np.testing.assert_allclose(alone.by_bounce[1:], found.by_bounce[1:], rtol=1e-12)
    # every path has one ray towards the light at its point, unless that is below its horizon
    assert alone.n_rays < found.n_rays - 0.3 * found.passes[..., 0].size * 64


def test_without_bounces_there_is_no_indirect_light(nook):
    points, light = seen_points(nook), uneven()
    assert not trace(nook, NOOK_MATERIALS, points, light, n_bounces=0).indirect.any()
    alone = trace(nook, NOOK_MATERIALS, points, light, n_bounces=0, indirect_only=True)
    assert not alone.passes.any()


def test_roulette_keeps_the_expectation_and_saves_rays(nook):
    dim = materials(*(Lambert(np.array([value])) for value in (0.3, 0.2, 0.25)))
    points, light = seen_points(nook), uneven()
    options = {"n_bounces": 4, "n_passes": 12, "n_samples": 32}
    full = trace(nook, dim, points, light, **options)
    played = trace(nook, dim, points, light, **options, seed=7, roulette_from=1)
    assert_same_expectation(full, played)
    assert played.n_rays < 0.8 * full.n_rays
    # the negative twin: paths that end without weight for the others lose light
    assert full.by_bounce[1:].mean() > 10.0 * np.sqrt(full.variance.mean() / full.mean.size)


def test_textures_multiply_the_brdf(nook):
    points, light = seen_points(nook), uneven()
    shade = np.array([0.5, 0.25, 1.0])

    def texture(triangles, barycentrics):
        assert barycentrics.shape == (len(triangles), 3)
        return np.tile(shade, (len(triangles), 1))

    textured = materials(*(Lambert(np.ones(1)) for _ in range(3)), texture=texture)
    plain = materials(*(Lambert(shade) for _ in range(3)))
    found = trace(nook, textured, points, light, n_bounces=2)
    expected = trace(nook, plain, points, light, n_bounces=2)
    np.testing.assert_allclose(found.passes, expected.passes, rtol=1e-12)


def test_backs_are_black_unless_two_sided():
    """A floor under a disc that faces up: its back sends light down only if it has two sides."""
    floor, shade = disc(1.0, 0.0, 3, 12, up=True), disc(1.0, 0.5, 3, 12, up=True)
    below = disc(3.0, -0.5, 3, 12, up=True)
    scene = Scene.from_parts([floor, shade, below])
    white = Lambert(np.array([0.8]))
    points = PathPoints.of_vertices(scene, np.arange(5), np.tile([0.0, 1.0, 0.0], (5, 1)))
    options = {"n_bounces": 3, "n_passes": 12, "n_samples": 128}
    one = trace(scene, materials(white, white, white), points, constant(16), **options)
    parts = [PathMaterial(white), PathMaterial(white, two_sided=True), PathMaterial(white)]
    two = trace(scene, parts, points, constant(16), **options)
    lower = turned_inside_out(shade)
    lower = replace(lower, positions=shade.positions - [0.0, 1e-4, 0.0])
    pair = Scene.from_parts([floor, shade, below, lower])
    twin = trace(pair, materials(*[white] * 4), points, constant(16), **options, seed=3)
    assert_same_expectation(two, twin, slack=1e-4)
    assert not one.by_bounce[1:].any()
    assert (two.mean - one.mean).min() > 0.1
    assert two.by_bounce[0] == pytest.approx(one.by_bounce[0], abs=1e-12)


def test_a_two_sided_point_seen_from_behind_is_turned():
    scene = Scene.from_parts([patch([-1, 0, 1], [2, 0, 0], [0, 0, -2], 1, 1)])
    down = np.array([[0.0, -1.0, 0.0]])
    triangle, middle = np.zeros(1, np.int64), np.full((1, 3), 1 / 3)
    turned, shows = PathPoints.seen(scene, triangle, middle, down, np.ones(1, np.bool_))
    assert shows.all()
    assert turned.surface.side[0] == pytest.approx([0.0, -1.0, 0.0])
    frame = turned.frames[0]
    assert frame @ frame.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    assert frame[2] == pytest.approx([0.0, -1.0, 0.0])
    _, shows = PathPoints.seen(scene, triangle, middle, down, np.zeros(1, np.bool_))
    assert not shows.any()


def test_frames_are_orthonormal_where_corners_disagree():
    """At the pole of the default frames the corners' tangents cancel."""
    scene = Scene.from_parts([ball(1)])
    n = scene.n_faces
    points, _ = PathPoints.seen(
        scene, np.arange(n), np.full((n, 3), 1 / 3),
        scene.normals[scene.faces].mean(axis=1), np.zeros(n, np.bool_),
    )  # fmt: skip
    assert np.einsum("pij,pkj->pik", points.frames, points.frames) == pytest.approx(
        np.tile(np.eye(3), (n, 1, 1)), abs=1e-9
    )
    assert points.frames[:, 2] == pytest.approx(points.surface.normals)
    flat = tangent_frames(points.surface.normals)
    away = np.abs(points.surface.normals[:, 1]) < 0.7
    # away from the poles the mixed tangents are the default ones, nearly
    assert (points.frames[away, 0] * flat[away, 0]).sum(axis=1).min() > 0.99


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"n_bounces": -1}, "n_bounces"),
        ({"n_passes": 0}, "at least 1"),
        ({"n_samples": 0}, "at least 1"),
        ({"parts": NOOK_MATERIALS[:2]}, "3 parts, but 2 materials"),
    ],
)
def test_what_is_refused(nook, change, message):
    parts = change.pop("parts", NOOK_MATERIALS)
    with pytest.raises(SettingsError, match=message):
        trace(nook, parts, seen_points(nook), constant(16), **change)


def test_one_pass_has_no_variance(nook):
    found = trace(nook, NOOK_MATERIALS, seen_points(nook), constant(16), n_passes=1)
    with pytest.raises(SettingsError, match="two or more"):
        _ = found.variance
