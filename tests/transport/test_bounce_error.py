"""The error of a bounce told from two draws, and the rays and means chosen by it."""

import numpy as np
import pytest

from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.bounce_error import bounce_error, draw_vertices, mean_error
from prtbake_workers.transport.ray_pilot import FEWEST, pilot_rays
from prtbake_workers.transport.smoothing import Smoothing
from support.bounce_scenes import ball

SCENE = Scene.from_parts([ball(3)])
SMOOTHING = Smoothing.of_part(SCENE, 0, factorise(Lambert(np.array([1.0]))))
AREA = float(SCENE.areas.sum())
N_COEFFS = 48


class Bounce:
    """A bounce whose truth is known: waves over the sphere, and chance that falls with the rays."""

    def __init__(self, waves, chance):
        self.truth = np.repeat(np.cos(waves * SCENE.positions[:, :1]), N_COEFFS, axis=1)
        self.chance = chance

    def drawn(self, vertices, n_rays, seed):
        noise = np.random.default_rng([seed, n_rays]).standard_normal((SCENE.n_vertices, N_COEFFS))
        scale = np.sqrt(self.chance / N_COEFFS) * n_rays ** (-2 / 3)
        return (self.truth + scale * noise)[vertices, None, None].astype(np.float32)

    def everywhere(self, n_rays, seed=0):
        return self.drawn(np.arange(SCENE.n_vertices), n_rays, seed)

    def error(self, found):
        """Squared and summed over the surface: what is to be told."""
        return float(SCENE.areas @ ((found[:, 0, 0] - self.truth) ** 2).sum(axis=1))


def measured(bounce, n_rays=1):
    return bounce_error(
        SCENE,
        lambda _part, vertices, seed: bounce.drawn(vertices, n_rays, seed),
        seed=0,
        arriving=[bounce.everywhere(n_rays)],
        smoothings=[SMOOTHING],
    )


@pytest.mark.parametrize("waves", [1.0, 4.0, 12.0, 40.0])
def test_the_error_told_is_that_of_what_is_kept(waves):
    bounce = Bounce(waves, chance=1.0)
    energy, (rounds,) = measured(bounce)
    kept = bounce.error(SMOOTHING.apply(bounce.everywhere(1), rounds))
    # 128 vertices, and one standard error on top
    assert 0.8 * kept < energy[0] < 1.6 * kept
    # nothing tried is better by more than that
    for other in (0, 1, 2, 4):
        assert bounce.error(SMOOTHING.apply(bounce.everywhere(1), other)) > 0.6 * kept


def test_slow_light_is_averaged_far_and_fast_light_not_at_all():
    assert measured(Bounce(1.0, chance=1.0)).rounds == (4,)
    assert measured(Bounce(40.0, chance=0.1)).rounds == (0,)
    assert measured(Bounce(1.0, chance=0.0)).rounds == (0,)


def test_an_error_against_one_draw_alone_would_hold_the_chance_of_that_as_well():
    """Negative twin of the product of two draws: the square of one is too large by its own."""
    bounce = Bounce(1.0, chance=1.0)
    chosen = draw_vertices(SCENE.areas, 128, 0)
    smooth = SMOOTHING.apply(bounce.everywhere(1), 4)[chosen]
    x, y = (bounce.drawn(chosen, 1, seed) for seed in (1, 2))
    true = float(((smooth - bounce.truth[chosen, None, None]) ** 2).sum(axis=(1, 2, 3)).mean())
    assert mean_error(smooth, x, y) < 2.0 * true
    assert float(((smooth - x) ** 2).sum(axis=(1, 2, 3)).mean()) > 10.0 * true


def piloted(bounce, allowed, most=256):
    return pilot_rays(bounce.drawn, SMOOTHING, SCENE.areas, most=most, allowed=allowed, seed=0)


def test_the_pilot_takes_as_few_rays_as_means_allow():
    bounce = Bounce(1.0, chance=10.0)
    taken = {allowed: piloted(bounce, allowed) for allowed in (1e-1, 3e-2, 1e-2)}
    assert taken[1e-1] == FEWEST
    assert FEWEST < taken[3e-2] < taken[1e-2] < 256
    for allowed, n_rays in taken.items():
        smooth = SMOOTHING.apply(bounce.everywhere(n_rays), 1)
        assert bounce.error(smooth) / AREA < allowed
        # without means it would not do
        assert n_rays == FEWEST or bounce.error(bounce.everywhere(n_rays)) / AREA > 2.0 * allowed


def test_all_rays_are_taken_where_means_blur_or_nothing_is_allowed():
    assert piloted(Bounce(40.0, chance=10.0), 3e-2) == 256
    assert piloted(Bounce(1.0, chance=10.0), 0.0) == 256
    assert piloted(Bounce(1.0, chance=10.0), 1e-1, most=FEWEST - 1) == FEWEST - 1
