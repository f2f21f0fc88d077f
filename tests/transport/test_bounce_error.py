"""The error of a bounce told from two draws, and the rays and means chosen by it."""

import numpy as np
import pytest

from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.bounce_error import (
    bounce_error,
    draw_vertices,
    squared_errors,
    with_standard_error,
)
from prtbake_workers.transport.ray_pilot import FEWEST, WORTH_TRYING, pilot_rays
from prtbake_workers.transport.smoothing import Smoothing
from support.bounce_scenes import ball

SCENE = Scene.from_parts([ball(3)])
SMOOTHING = Smoothing.of_part(SCENE, 0, factorise(Lambert(np.array([1.0]))))
AREA = float(SCENE.areas.sum())
N_COEFFS = 4
"""Few, as those of real light depend on each other: the estimate is as rough as that of them."""


class Bounce:
    """A bounce whose truth is known: waves over the sphere, and chance that falls with the rays."""

    def __init__(self, waves, chance, n_coeffs=N_COEFFS):
        self.truth = np.repeat(np.cos(waves * SCENE.positions[:, :1]), n_coeffs, axis=1)
        self.chance, self.n_coeffs = chance, n_coeffs

    def drawn(self, vertices, n_rays, seed):
        noise = np.random.default_rng([seed, n_rays]).standard_normal(self.truth.shape)
        scale = np.sqrt(self.chance / self.n_coeffs) * n_rays ** (-2 / 3)
        return (self.truth + scale * noise)[vertices, None, None].astype(np.float32)

    def everywhere(self, n_rays, seed=0):
        return self.drawn(np.arange(SCENE.n_vertices), n_rays, seed)

    def error(self, found):
        """Squared and summed over the surface: what is to be told."""
        return float(SCENE.areas @ ((found[:, 0, 0] - self.truth) ** 2).sum(axis=1))


def measured(bounce, seed=0):
    return bounce_error(
        SCENE,
        lambda _part, vertices, own: bounce.drawn(vertices, 1, own),
        [bounce.everywhere(1, seed)],
        [SMOOTHING],
        seed=seed,
    )


@pytest.mark.parametrize("waves", [1.0, 4.0, 12.0, 40.0])
def test_the_error_told_is_that_of_what_is_kept(waves):
    bounce = Bounce(waves, chance=1.0)
    told, kept = [], []
    for seed in range(0, 60, 3):
        energy, (rounds,) = measured(bounce, seed)
        plain = bounce.everywhere(1, seed)
        errors = {n: bounce.error(SMOOTHING.apply(plain, n)) for n in (0, 1, 2, 4)}
        told.append(energy[0])
        kept.append(errors[rounds])
        # nothing tried is better by much
        assert errors[rounds] < 2.0 * min(errors.values())
    # one standard error of the estimate is on top: where means take nearly all, that is most of it
    assert np.mean(kept) < np.mean(told) < 3.0 * np.mean(kept)
    assert min(told) > 0.3 * np.mean(kept)


def test_slow_light_is_averaged_far_and_fast_light_not_at_all():
    assert measured(Bounce(1.0, chance=1.0)).rounds == (4,)
    assert measured(Bounce(40.0, chance=0.1)).rounds == (0,)
    assert measured(Bounce(1.0, chance=0.0)).rounds == (0,)


def test_an_error_against_one_draw_alone_would_hold_the_chance_of_that_as_well():
    """Negative twin of the product of two draws: the square of one is too large by its own."""
    bounce = Bounce(1.0, chance=1.0)
    drawn = draw_vertices(SCENE.areas, 128, [0, 1])
    chosen = drawn.vertices
    smooth = SMOOTHING.apply(bounce.everywhere(1), 4)[chosen]
    x, y = (bounce.drawn(chosen, 1, seed) for seed in (1, 2))
    true = float(((smooth - bounce.truth[chosen, None, None]) ** 2).sum(axis=(1, 2, 3)).mean())
    assert with_standard_error(squared_errors(smooth, x, y), drawn) < 4.0 * true
    assert float(((smooth - x) ** 2).sum(axis=(1, 2, 3)).mean()) > 10.0 * true


def piloted(bounce, allowed, most=256):
    return pilot_rays(bounce.drawn, SMOOTHING, SCENE.areas, most=most, allowed=allowed, seed=0)


def test_the_pilot_takes_as_few_rays_as_means_allow():
    bounce = Bounce(1.0, chance=10.0, n_coeffs=48)
    taken = {allowed: piloted(bounce, allowed) for allowed in (3e-1, 3e-2, 1e-2)}
    assert taken[3e-1] == FEWEST
    assert FEWEST < taken[3e-2] < taken[1e-2] < 256
    for allowed, n_rays in taken.items():
        smooth = SMOOTHING.apply(bounce.everywhere(n_rays), 1)
        assert bounce.error(smooth) / AREA < allowed
        # without means it would not do
        assert n_rays == FEWEST or bounce.error(bounce.everywhere(n_rays)) / AREA > 2.0 * allowed


def test_all_rays_are_taken_where_means_blur_or_nothing_is_allowed():
    assert piloted(Bounce(40.0, chance=10.0, n_coeffs=48), 3e-2) == 256
    assert piloted(Bounce(1.0, chance=10.0, n_coeffs=48), 0.0) == 256
    assert piloted(Bounce(1.0, chance=0.0, n_coeffs=48), 1e-1, most=WORTH_TRYING - 1) == 15
    assert piloted(Bounce(1.0, chance=0.0, n_coeffs=48), 1e-1, most=WORTH_TRYING) == FEWEST


def test_what_is_drawn_twice_tells_nothing_new():
    """The standard error on top, of eight vertices of equal area that 128 draws fall on."""
    drawn = draw_vertices(np.ones(8), 128, [0, 1])
    np.testing.assert_array_equal(drawn.vertices, np.arange(8))
    assert drawn.shares.sum() == pytest.approx(1.0, rel=1e-12)
    errors = np.random.default_rng(3).exponential(size=(2000, 8))
    told = np.mean([with_standard_error(row, drawn) - drawn.shares @ row for row in errors])
    true = np.std(errors @ drawn.shares)
    assert told == pytest.approx(true, rel=0.2)
    # negative twin: as if all draws had been independent
    assert np.std(errors) / np.sqrt(128) < 0.4 * true
