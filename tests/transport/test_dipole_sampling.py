"""Where light entered: sampled sums against the integral over triangles and quadrature."""

import numpy as np
import pytest

from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport import dipole_sampling
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.dipole_sampling import DipoleSampler
from prtbake_workers.transport.hat_moments import hat_moments
from prtbake_workers.transport.path_points import PathPoints
from support.bounce_scenes import ball, patch

N_SAMPLES = 16_000


def marble(path):
    """With its red mean free path at so many scene units."""
    one = Dipole.of_material("marble", mm_per_unit=1.0)
    return Dipole.of_material("marble", mm_per_unit=one.mean_free_path[0] / path)


def together(*meshes):
    """Several meshes as one part."""
    scene = Scene.from_parts(meshes)
    return Mesh(scene.positions, scene.faces, scene.normals, None)


FLOOR = patch([-3, -3, 3], [6, 0, 0], [0, 0, -6], 2, 2)


@pytest.fixture(scope="module")
def cup():
    """Two balls and a wall as one part: lines through it meet up to five triangles."""
    wall = patch([-1, -1, -1.2], [2, 0, 0], [0, 2, 0], 2, 2)
    part = together(ball(1), ball(1, centre=(0.3, 1.9, 0.0), radius=0.6), wall)
    return Scene.from_parts([FLOOR, part])


def point_on(scene, part, triangle):
    """One point, many times over."""
    triangles = np.full(N_SAMPLES, np.flatnonzero(scene.part_of_face == part)[triangle])
    weights = np.tile([0.5, 0.3, 0.2], (N_SAMPLES, 1))
    wo = np.cross(
        *(
            scene.positions[scene.faces[triangles[0]]][1:]
            - scene.positions[scene.faces[triangles[0], 0]]
        )
    )
    wo = np.tile(wo / np.linalg.norm(wo), (N_SAMPLES, 1))
    return PathPoints.seen(scene, triangles, weights, wo, np.zeros(N_SAMPLES, np.bool_))[0]


def exact(scene, part, dipole, at, values):
    """F integral of R_d times values that are linear over triangles."""
    corners = scene.faces[scene.part_of_face == part]
    points = np.tile(at.surface.positions[0], (len(corners), 1))
    weights = hat_moments(dipole, points, scene.positions[corners])
    return dipole.entering_transmittance * np.einsum("cpk,pk->c", weights, values[corners])


def sampled(scene, sampler, at, values, seed=0):
    """Mean, and standard deviation of one sample, relative."""
    u = np.random.default_rng(seed).random((len(at), 5))
    points, weights = sampler.enter(at, u)
    taken = np.einsum("nc,nc->n", points.barycentrics, values[scene.faces[points.triangles]])
    each = weights * taken[:, None]
    return each.mean(axis=0), each.std(axis=0)


@pytest.mark.parametrize("path", [3e-4, 0.02, 0.1, 0.5, 3.0, 1e4])
@pytest.mark.parametrize("triangle", [3, 100, -1])
def test_means_are_the_integral_over_triangles(cup, path, triangle):
    dipole = marble(path)
    sampler = DipoleSampler(cup, 1, dipole)
    at = point_on(cup, 1, triangle)
    values = 1.0 + 0.8 * np.sin(3.0 * cup.positions[:, 0] + cup.positions[:, 1])
    expected = exact(cup, 1, dipole, at, values)
    mean, deviation = sampled(cup, sampler, at, values)
    error = deviation / np.sqrt(N_SAMPLES)
    assert (np.abs(mean - expected) < 4.0 * error + 1e-4 * expected).all()
    # few samples tell: no weight dwarfs the others
    assert (deviation < 3.0 * expected).all()
    # negative twin: the medium of another path, where the part is not wide for either
    if path >= 0.5:
        other = sampled(cup, DipoleSampler(cup, 1, marble(1.3 * path)), at, values)[0]
        assert (np.abs(other - expected) > 6.0 * error).any()


def test_one_intersection_of_a_line_stands_for_all(cup, monkeypatch):
    """The negative twin of the reservoir: a line that stops at its first intersection."""
    dipole, at = marble(0.5), point_on(cup, 1, 100)
    values = np.ones(cup.n_vertices)
    expected = exact(cup, 1, dipole, at, values)
    monkeypatch.setattr(dipole_sampling, "MOST_INTERSECTIONS", 1)
    mean, deviation = sampled(cup, DipoleSampler(cup, 1, dipole), at, values)
    assert (np.abs(mean - expected) > 10.0 * deviation / np.sqrt(N_SAMPLES)).all()


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_any_mixture_has_the_same_mean(cup, share, monkeypatch):
    monkeypatch.setattr(dipole_sampling, "LINE_SHARE", share)
    dipole, at = marble(0.3), point_on(cup, 1, 40)
    values = np.ones(cup.n_vertices)
    expected = exact(cup, 1, dipole, at, values)
    mean, deviation = sampled(cup, DipoleSampler(cup, 1, dipole), at, values, seed=1)
    assert (np.abs(mean - expected) < 4.0 * deviation / np.sqrt(N_SAMPLES)).all()


def test_a_wide_plane_gives_back_its_albedo():
    scene = Scene.from_parts([patch([-50, 0, 50], [100, 0, 0], [0, 0, -100], 3, 3)])
    dipole, at = marble(0.02), point_on(scene, 0, 8)
    mean, deviation = sampled(scene, DipoleSampler(scene, 0, dipole), at, np.ones(16))
    error = deviation / np.sqrt(N_SAMPLES)
    np.testing.assert_array_less(np.abs(mean - dipole.diffuse_albedo), 4.0 * error + 1e-3)


def test_a_path_below_the_resolution_of_rays_stays_where_it_is(cup):
    dipole, at = marble(1e-9), point_on(cup, 1, 7)
    points, weights = DipoleSampler(cup, 1, dipole).enter(at, np.full((N_SAMPLES, 5), 0.3))
    np.testing.assert_array_equal(points.triangles, at.triangles)
    np.testing.assert_allclose(weights, np.tile(dipole.diffuse_albedo, (N_SAMPLES, 1)))


def test_black_and_white_media(cup):
    at, values = point_on(cup, 1, 7), np.ones(cup.n_vertices)
    black = Dipole(np.array([0.0, 5.0, 5.0]), np.array([3.0, 0.0, 1.0]), 1.3)
    mean, deviation = sampled(cup, DipoleSampler(cup, 1, black), at, values)
    expected = exact(cup, 1, black, at, values)
    assert mean[0] == expected[0] == 0.0
    assert (np.abs(mean - expected)[1:] < 4.0 * deviation[1:] / np.sqrt(N_SAMPLES)).all()
    alone = Dipole(np.array([0.0]), np.array([3.0]), 1.3)
    assert not sampled(cup, DipoleSampler(cup, 1, alone), at, values)[0].any()
