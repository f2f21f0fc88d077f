"""The reference integrator against closed forms."""

import numpy as np
import pytest

from prtbake_workers.environment.procedural import constant
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.transport.reference import SurfacePoints, visible_cosine
from prtbake_workers.validation.light import draw_pass

UP = np.array([[0.0, 1.0, 0.0]])


def irradiance(points, accelerator, epsilon, rng, n=20_000):
    light = draw_pass(EnvironmentSampler(constant(64)), np.eye(3), n, rng)
    return visible_cosine(points, light.directions, accelerator, epsilon) @ light.weights


def test_irradiance_of_a_unit_sky_is_pi(rng):
    points = SurfacePoints(np.zeros((1, 3)), UP, UP)
    # standard error of n stratified samples is far below that of plain ones, 0.7 %
    assert irradiance(points, None, 1e-6, rng) == pytest.approx(np.pi, rel=0.01)


@pytest.mark.parametrize("height", [1.5, 3.0])
def test_a_sphere_overhead_takes_its_squared_sine(rng, height):
    """A ball of radius 1 straight above blocks sin^2 of its half angle of the irradiance."""
    ball = sphere_mesh(4)
    accelerator = Accelerator(ball.positions + np.array([0.0, height - 1.0, 0.0]), ball.faces)
    points = SurfacePoints(np.zeros((1, 3)), UP, UP)
    free = irradiance(points, accelerator, 1e-6, rng)
    expected = np.pi * (1.0 - 1.0 / height**2)
    assert free == pytest.approx(expected, rel=0.02)  # 1 % sampling, 0.3 % faceted ball
    assert free != pytest.approx(np.pi, rel=0.02)  # the negative twin: no shadow at all


def test_points_on_a_convex_surface_see_their_whole_hemisphere(rng):
    ball = sphere_mesh(3)
    accelerator = Accelerator(ball.positions, ball.faces)
    epsilon = ray_epsilon(ball.bounds)
    points = SurfacePoints(ball.positions[:20], ball.normals[:20], ball.normals[:20])
    light = draw_pass(EnvironmentSampler(constant(64)), np.eye(3), 2000, rng)
    free = visible_cosine(points, light.directions, None, epsilon)
    traced = visible_cosine(points, light.directions, accelerator, epsilon)
    np.testing.assert_array_equal(traced, free)


def test_a_point_inside_a_closed_mesh_is_black(rng):
    ball = sphere_mesh(3)
    accelerator = Accelerator(ball.positions, ball.faces)
    points = SurfacePoints(np.array([[0.1, 0.9, 0.2]]), UP, UP)
    assert not irradiance(points, accelerator, 1e-6, rng).any()
