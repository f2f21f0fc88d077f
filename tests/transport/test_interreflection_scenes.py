"""Scenes with a known answer: the sparse operator and the path tracer, each against it.

The tracer's tolerances are its own standard errors, from 8 passes (Student's t with 7 degrees of
freedom: 4 to 7 of them happen among a hundred values), plus what the tessellation costs; the
operator's are stated with what was measured over two seeds.
"""

import numpy as np
import pytest

from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.environment.procedural import constant
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.interreflection import bounce_series
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
from support.analytic_scenes import ball_on_plane, furnace, half_sky, plates
from support.bounce_scenes import (
    ball,
    opaque,
    patch,
    point_to_wall,
)

N_RAYS = 256


def operator(scene, albedo, n_rays=N_RAYS, seed=2):
    return build_bounce_block(
        opaque(scene), (0, scene.n_vertices), albedo=albedo, n_rays=n_rays, seed=seed
    )


def per_part(scene, values):
    """Albedo from one colour a part."""
    sizes = [stop - start for start, stop in scene.part_ranges]
    return Albedo.of_vertices(scene.faces, np.repeat(np.array(values, np.float64), sizes, axis=0))


def series(scene, direct, block, n_bounces):
    direct = np.asarray(direct, np.float32).reshape(-1, 1)
    found = bounce_series(
        direct, block.matrices, areas=scene.areas, tolerance=0.0, max_bounces=n_bounces
    )
    return found.transfer[:, :, 0], found.report


def traced(scene, albedos, vertices, light, n_bounces, *, n_samples=256, n_passes=8):
    """Mean radiance of vertices and its standard error."""
    vertices = np.asarray(vertices)
    found = trace_paths(
        opaque(scene),
        [PathMaterial(Lambert(np.array(albedo, np.float64))) for albedo in albedos],
        PathPoints.of_vertices(scene, vertices, scene.normals[vertices]),
        light,
        np.eye(3),
        n_bounces=n_bounces,
        n_passes=n_passes,
        n_samples=n_samples,
        seed=4,
    )
    return found.mean, np.sqrt(found.variance)


# --- white furnace: in a spherical bowl of share s every point sees the share s of bowl,
#     so that after B bounces X = 1 - s^(B+1), at albedo 1


@pytest.fixture(scope="module")
def white_bowl():
    scene = furnace().scene
    return scene, operator(scene, Albedo.constant(1.0))


@pytest.mark.parametrize("n_bounces", [0, 1, 2, 4, 8])
def test_furnace_after_each_bounce(white_bowl, n_bounces):
    scene, block = white_bowl
    found, _ = series(scene, block.escaped, block, n_bounces)
    expected = 1.0 - 0.5 ** (n_bounces + 1)
    mean = scene.areas @ found[0] / scene.areas.sum()
    # 5e-4 was measured: vertices lie on the sphere, what they see a little inside it
    assert mean == pytest.approx(expected, abs=1e-3)
    # 256 rays a vertex: 0.020 at worst was measured, half of it with every bounce
    assert np.abs(found[0] - expected).max() < 0.03 * 0.5**n_bounces


def test_furnace_tends_to_one(white_bowl):
    scene, block = white_bowl
    found, report = series(scene, block.escaped, block, 60)
    # rows of F and the escaped share sum to 1 in each vertex, so 1 solves the equation exactly
    assert np.abs(found[0] - 1.0).max() < 1e-5
    assert report.remainder < 1e-12
    # the bound cuts the count, with a message
    cut = bounce_series(
        block.escaped.astype(np.float32)[:, None],
        block.matrices,
        areas=scene.areas,
        tolerance=1e-6,
        max_bounces=3,
    )
    assert (cut.report.n_bounces, cut.report.converged) == (3, False)
    assert "max_bounces = 3" in cut.report.messages[0]
    assert "bounces left out may add up to" in cut.report.messages[1]
    truth = scene.areas @ (1.0 - cut.transfer[0, :, 0].astype(np.float64)) ** 2
    norm = scene.areas @ cut.transfer[0, :, 0].astype(np.float64) ** 2
    assert truth / norm <= cut.report.remainder <= 1.1 * truth / norm
    enough = bounce_series(
        block.escaped.astype(np.float32)[:, None],
        block.matrices,
        areas=scene.areas,
        tolerance=1e-6,
        max_bounces=30,
    ).report
    assert enough.converged
    # bounce k adds 4^-(k+1) of the whole, below 1e-6 at k = 9
    assert enough.n_bounces == 9


@pytest.mark.parametrize(("albedo", "n_bounces"), [(1.0, 0), (0.6, 1), (1.0, 4), (0.6, 4)])
def test_furnace_by_paths(white_bowl, albedo, n_bounces):
    scene, _ = white_bowl
    inner = np.flatnonzero(scene.positions[:, 1] < -0.2)[::9]
    mean, error = traced(scene, [[albedo]], inner, constant(16), n_bounces)
    expected = albedo * 0.5 * sum((0.5 * albedo) ** k for k in range(n_bounces + 1))
    assert (np.abs(mean - expected) < 7.0 * error + 1e-3).all()
    # the channels of grey paths are one number: a vertex counts once; 5e-4 for the polyhedron
    assert abs(mean.mean() - expected) < 4.0 * np.sqrt((error**2).mean() / len(inner)) + 5e-4
    # the negative twin: one bounce more or less is far outside
    step = albedo * 0.5 * (0.5 * albedo) ** (n_bounces + 1)
    assert step > 2.0 * abs(mean.mean() - expected)


def test_a_closed_mesh_seen_from_inside_is_black():
    scene = Scene.from_parts([ball(3, inward=True)])
    block = operator(scene, Albedo.constant(0.9))
    assert not block.escaped.any()
    found, report = series(scene, block.escaped, block, 5)
    assert not found.any()
    assert report.remainder == 0.0
    mean, error = traced(scene, [[0.9]], np.arange(0, 600, 40), constant(16), 5)
    assert not mean.any()
    assert not error.any()


# --- two equal discs, light of radiance 1 from all around


@pytest.mark.parametrize("height", [0.4, 1.0])
def test_two_plates(height):
    n_bounces, albedo = 4, 0.8
    case = plates(height, n_bounces)
    scene, inside = case.scene, case.vertices
    block = operator(scene, Albedo.constant(albedo))
    for k in (0, 1, 2, n_bounces):
        found, _ = series(scene, block.escaped, block, k)
        wrong = found[0, inside] - case.answers[k]
        # 256 rays with a rim across them, 12 rings of linear interpolation between vertices:
        # 5.6e-3 root mean square and a bias of 1.2e-3 were measured
        assert np.sqrt((wrong**2).mean()) < 8e-3
        assert abs(wrong.mean()) < 2e-3
    # the negative twin: a bounce too few
    assert abs(np.mean(found[0, inside] - case.answers[1])) > 0.03
    some = slice(None, None, len(inside) // 40)
    mean, error = traced(scene, [[albedo]] * 2, inside[some], case.light, n_bounces)
    truth = albedo * case.truth[some, None]
    # the polygon has the disc's area, not its outline: 5e-4
    assert (np.abs(mean - truth) < 7.0 * error + 5e-4).all()
    assert abs((mean - truth).mean()) < 4.0 * np.sqrt((error**2).mean() / len(mean)) + 5e-4


# --- a ball on a plane, half a sky: the plane at offset r keeps 1 - (1 + r^2)^(-3/2) of the sky


def test_ball_on_plane():
    case = ball_on_plane()
    scene, answers = case.scene, case.answers
    open_, occluded = case.vertices, 1.0 - answers[0]
    block = operator(scene, per_part(scene, [[0.0], [0.8]]), n_rays=1024)
    # 1024 rays with the ball's outline across them: 1.4e-3 root mean square was measured; the ball
    # of 2,562 vertices is 0.3 % too small, of 0.07 on average
    wrong = 1.0 - block.escaped[open_] - occluded
    assert np.sqrt((wrong**2).mean()) < 2.5e-3
    assert abs(wrong.mean()) < 4e-4
    found, _ = series(scene, case.direct, block, 1)
    some = slice(None, None, len(open_) // 24)
    wrong = found[0, open_[some]] - answers[1, some]
    # of bounces from 0.006 to 0.054
    assert np.abs(wrong).max() < 2.5e-3
    assert abs(wrong.mean()) < 4e-4
    mean, error = traced(scene, [[0.5], [0.8]], open_[some], case.light, 1)
    truth = 0.5 * answers[1, some, None]
    assert (np.abs(mean - truth) < 7.0 * error + 5e-4).all()
    assert abs((mean - truth).mean()) < 4.0 * np.sqrt((error**2).mean() / len(mean)) + 2e-4
    # the negative twin: without the bounce the plane is darker than the tolerance allows
    assert np.abs(mean - 0.5 * answers[0, some, None]).max() > 0.02


# --- a coloured wall beside a patch of floor, half a sky: the wall has 1/2 and covers F of the sky


@pytest.mark.parametrize(("height", "half_width", "distance"), [(2, 1.5, 0.5), (40, 40, 0.5)])
def test_a_coloured_wall_bleeds_onto_the_floor(height, half_width, distance):
    """At 40 times the distance the wall covers half of the floor's hemisphere, F = 0.496."""
    wall = patch([-half_width, 0, 0], [2 * half_width, 0, 0], [0, height, 0], 2, 2)
    floor = patch([-0.1, 0, 4 * distance], [0.2, 0, 0], [0, 0, -3 * distance], 2, 6)
    scene = Scene.from_parts([floor, wall])
    bright = np.array([0.9, 0.3, 0.1])
    (start, stop), (first, _) = scene.part_ranges
    middle = start + np.flatnonzero(scene.positions[start:stop, 0] == 0.0)
    covered = point_to_wall(scene.positions[middle, 2], height, half_width)
    assert covered.max() > (0.49 if height == 40 else 0.3)
    block = operator(scene, per_part(scene, [[0.0] * 3, bright]), n_rays=1024)
    direct = np.where(np.arange(scene.n_vertices) >= first, 0.5, 0.0)
    direct[middle] = 1.0 - covered
    found, _ = series(scene, direct, block, 1)
    truth = 1.0 - covered + 0.5 * bright[:, None] * covered
    # 1024 rays: 1.9e-3 was measured
    assert np.abs(found[:, middle] - truth).max() < 3e-3
    mean, error = traced(scene, [[0.5], bright], middle, half_sky(), 1)
    assert (np.abs(mean - 0.5 * truth.T) < 7.0 * error).all()
    # the colour is the wall's: the red channel gains nine times what the blue one does
    gained = mean - 0.5 * (1.0 - covered)[:, None]
    assert gained.sum(axis=0)[0] / gained.sum(axis=0)[2] == pytest.approx(9.0, rel=0.1)
