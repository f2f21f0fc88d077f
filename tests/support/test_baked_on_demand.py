"""Baking what is asked for gives what baking everything gives."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.brdf.lambert import Lambert
from support.baked_on_demand import BakedOnDemand
from support.baked_scene import baked
from support.bounce_scenes import ball, patch
from support.mitsuba_scenes import DiffuseAndMetal
from support.scenes import relative_difference

SETTINGS = BakeSettings(
    cube_resolution=8, n_centres=42, n_terms=4, bounce_rays=16, max_bounces=2, bounce_tolerance=0.0
)
GLOSSY = DiffuseAndMetal(np.array([0.5, 0.4, 0.3]), 0.3, 0.3)


@pytest.fixture(scope="module")
def scene():
    """A glossy ball on a red plane with a wall far off, behind which another plane lies."""
    meshes = [
        ball(2),
        patch([-2, -1, 2], [4, 0, 0], [0, 0, -4], 8, 8),
        patch([-2, -9, -2], [4, 0, 0], [0, 0, 4], 8, 8),
    ]
    return meshes, [GLOSSY, Lambert(np.array([0.8, 0.3, 0.1])), Lambert(np.full(3, 0.5))]


def test_what_is_asked_for_is_as_in_the_whole(scene, rng):
    whole, some = baked(*scene, SETTINGS), BakedOnDemand(*scene, SETTINGS)
    light = rng.random((42, 6))
    for part, first, last in ((0, 5, 25), (1, 30, 50)):
        start = whole.scene.part_ranges[part][0]
        vertices = np.arange(start + first, start + last)
        expected = whole.lit_at(part, vertices, light)
        found = some.lit_at(part, vertices, light)
        # sums over other tiles: rounding of float32
        assert relative_difference(found, expected) < 1e-5
        # the negative twins: no bounce, one bounce
        direct = some.lit_at(part, vertices, light, bounces=False)
        assert (
            relative_difference(direct, whole.lit_at(part, vertices, light, bounces=False)) < 1e-5
        )
        assert relative_difference(direct, expected) > 0.01
    # the lower plane looks down and is never met
    assert some.n_baked <= whole.scene.part_ranges[2][0] < whole.scene.n_vertices


def test_one_bounce_less_is_something_else(scene, rng):
    light, vertices = rng.random((42, 3)), np.arange(20)
    two, one = (
        BakedOnDemand(*scene, SETTINGS.model_copy(update={"max_bounces": n})).lit_at(
            0, vertices, light
        )
        for n in (2, 1)
    )
    assert relative_difference(one, two) > 1e-3
