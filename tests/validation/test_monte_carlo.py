"""Light is summed over the samples that arrive, and BRDFs are asked about no others."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.geometry.ray_offset import ray_epsilon
from prtbake_workers.transport.reference import SurfacePoints, to_local, visible_cosine
from prtbake_workers.validation.exact_terms import ExactTerms
from prtbake_workers.validation.hits import trace_camera
from prtbake_workers.validation.light import draw_pass
from prtbake_workers.validation.monte_carlo import pixel_pictures, vertex_terms
from prtbake_workers.validation.sampled import sampled_terms
from support.baked_on_demand import BakedOnDemand
from support.baked_scene import camera_of, validation_of_baked
from support.bounce_scenes import ball, patch
from support.mitsuba_scenes import DiffuseAndMetal, View

GLOSSY = DiffuseAndMetal(np.array([0.5, 0.4, 0.3]), 0.3, 0.3)


class Asked:
    """A BRDF that keeps the cosines it was asked about."""

    n_channels = 3

    def __init__(self):
        self.cosines = []

    def eval_brdf(self, wi, wo):
        self.cosines.append(wi[:, 2])
        return GLOSSY.eval_brdf(wi, wo)


@pytest.fixture(scope="module")
def shown():
    """A glossy ball above a plane that lies under a far wider lid."""
    meshes = [
        ball(2),
        patch([-2, -1.2, 2], [4, 0, 0], [0, 0, -4], 4, 4),
        patch([-40, -1.199, 40], [80, 0, 0], [0, 0, -80], 1, 1),
    ]
    settings = BakeSettings(cube_resolution=8, n_centres=42, n_terms=4)
    sky = Environment(np.ones((8, 16, 3), np.float32))
    own = BakedOnDemand(meshes, [GLOSSY] * 3, settings)
    validation = validation_of_baked(own, sky, 4)
    view = View((0.0, 1.0, 6.0), (0.0, 0.0, 0.0), 40.0)
    hits = trace_camera(validation, camera_of(view), 24, 18)
    light = draw_pass(EnvironmentSampler(sky), np.eye(3), 64, np.random.default_rng(4))
    return validation, hits, light, ray_epsilon(own.scene.bounds)


def test_pictures_are_sums_over_all_samples(shown):
    validation, hits, light, epsilon = shown
    asked = Asked()
    parts = tuple(replace(part, brdf=asked) for part in validation.parts)
    watched = replace(validation, parts=parts)
    exact = [ExactTerms(part.factorisation) for part in parts]
    true, _, by_table = pixel_pictures(watched, hits, light, exact, epsilon)
    received = visible_cosine(hits.points, light.directions, validation.accelerator, epsilon)
    wi = to_local(hits.frames, light.directions)
    wo = np.einsum("pij,pj->pi", hits.frames, hits.wo)
    rho = GLOSSY.eval_brdf(wi, wo[:, None, :])
    expected = np.einsum("ps,psc,sc->pc", received, rho, light.weights)
    # the same numbers in another order
    np.testing.assert_allclose(true, expected, rtol=1e-12, atol=1e-14)
    assert 0.0 < np.abs(by_table - true).max() < 0.5 * true.max()
    cosines = np.concatenate(asked.cosines)
    assert len(cosines) == np.count_nonzero(received) < 0.8 * received.size
    assert (cosines > 0.0).all()
    # the negative twin: without shadows
    unshadowed = np.einsum("ps,psc,sc->pc", np.maximum(wi[..., 2], 0.0), rho, light.weights)
    assert np.abs(unshadowed - true).max() > 0.01 * true.max()


@pytest.mark.parametrize("part", [0, 1])
def test_terms_of_vertices_are_sums_over_all_samples(shown, part):
    """The plane under the lid gets nothing at all."""
    validation, _, light, epsilon = shown
    own, scene = validation.parts[part], validation.scene
    vertices = np.arange(*scene.part_ranges[part])
    points = SurfacePoints(
        scene.ray_points[vertices], scene.normals[vertices], scene.ray_sides[vertices]
    )
    columns = np.random.default_rng(5).random((validation.directions.n, 3))
    directions = validation.directions.directions
    for found, towards, weights in (
        (vertex_terms(validation, own, vertices, light, epsilon), light.directions, light.weights),
        (sampled_terms(validation, part, vertices, columns), directions, columns),
    ):
        received = visible_cosine(points, towards, validation.accelerator, epsilon)
        wi = to_local(scene.frames[vertices], towards)
        psi = own.factorisation.eval_psi(wi.reshape(-1, 3)).reshape(*wi.shape[:2], -1)
        expected = np.einsum("ps,psk,sc->pkc", received, psi, weights)
        # the same numbers in another order
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)
        assert found.any() == (part == 0)
