"""The operator's own error, predicted from two draws, against the one that is there."""

from functools import cache

import numpy as np
import pytest

from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_noise import bounce_noise
from prtbake_workers.transport.bounce_operator import build_bounce_block
from support.bounce_scenes import ball, bowl, opaque


@pytest.fixture(scope="module")
def scene():
    return Scene.from_parts([bowl(10, 40), ball(2, (0.0, -0.4, 0.0), 0.35)])


@pytest.fixture(scope="module")
def direct(scene):
    """Some transfer that varies over the surface: lobes about three directions."""
    axes = np.array([[0.0, 1.0, 0.0], [0.8, 0.6, 0.0], [-0.5, 0.5, 0.7]])
    return np.maximum(scene.normals @ axes.T, 0.0).astype(np.float32)


@pytest.fixture(scope="module")
def block(scene):
    """The operator's matrices for an albedo, a number of rays and a seed, each built once."""
    surface = opaque(scene)

    @cache
    def build(albedo, n_rays, seed):
        return build_bounce_block(
            surface, (0, scene.n_vertices), albedo=Albedo.constant(*albedo), n_rays=n_rays,
            seed=seed,
        ).matrices  # fmt: skip

    return build


@pytest.mark.parametrize("n_rays", [16, 64])
@pytest.mark.parametrize("albedo", [(0.7,), (0.9, 0.5, 0.2)])
def test_the_error_is_predicted(scene, direct, block, n_rays, albedo):
    first, second = block(albedo, n_rays, 1), block(albedo, n_rays, 2)
    # the operator is linear in an even albedo
    truth = [shade * block((1.0,), 2048, 3)[0] for shade in albedo]
    predicted = scene.areas @ bounce_noise(direct, first, second)
    actual = sum(
        scene.areas @ (((one - other) @ direct) ** 2).sum(axis=1)
        for one, other in zip(first, truth, strict=True)
    )
    # 560 rows of each: within 8 % was measured
    assert predicted == pytest.approx(actual, rel=0.2)
    # the negative twin: one draw against itself knows nothing
    assert not bounce_noise(direct, first, first).any()
    # and more rays err less: by 4^(3/2) at silhouettes, by 4 if rays were independent
    more = [block(albedo, 4 * n_rays, seed) for seed in (1, 2)]
    finer = scene.areas @ bounce_noise(direct, *more)
    assert finer < 0.25 * predicted
