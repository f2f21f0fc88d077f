"""Cosine-distributed directions: their density, and their independence of tiles."""

import numpy as np
import pytest

from prtbake_workers.transport.hemisphere_rays import (
    cosine_directions,
    lattice,
    shifted,
    shifts,
)


def directions(n, seed=3, n_points=50):
    return cosine_directions(shifted(lattice(n), shifts(seed, 0, n_points, 2)))


def test_directions_are_unit_vectors_above_the_surface():
    rays = directions(97)
    assert np.linalg.norm(rays, axis=-1) == pytest.approx(1.0, abs=1e-12)
    assert (rays[..., 2] > 0.0).all()


def test_density_is_the_cosine():
    """Moments of cos / pi: E z^k = 2 / (k + 2), E x = E y = E xy = 0, E x^2 = E y^2 = 1/4."""
    x, y, z = np.moveaxis(directions(1024, n_points=20).reshape(-1, 3), 1, 0)
    # 20,480 low-discrepancy samples: 1e-3 is twice what was measured at worst
    for moment, expected in [(z, 2 / 3), (z**2, 1 / 2), (z**4, 1 / 3), (x, 0.0), (y, 0.0),
                             (x * y, 0.0), (x * x, 0.25), (y * y, 0.25)]:  # fmt: skip
        assert moment.mean() == pytest.approx(expected, abs=1e-3)
    # the negative twin: uniform directions have E z = 1/2
    assert z.mean() != pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("n", [16, 64, 256])
def test_smooth_means_converge_faster_than_random_ones(n):
    """The root mean square error of E z over many shifts falls as 1/n, not as n^-1/2."""
    error = np.sqrt(((directions(n, n_points=400)[..., 2].mean(axis=1) - 2 / 3) ** 2).mean())
    random = np.sqrt(1.0 / 18.0 / n)  # variance of z is 1/2 - 4/9
    # sqrt(1 - u) over n strata: about 0.3 / n was measured
    assert error < 0.5 / n
    assert error < 0.5 * random


def test_shifts_do_not_depend_on_the_cut():
    whole = shifts(11, 0, 100, 5)
    pieces = np.concatenate([shifts(11, 0, 37, 5), shifts(11, 37, 38, 5), shifts(11, 38, 100, 5)])
    np.testing.assert_array_equal(whole, pieces)
    assert (whole != shifts(12, 0, 100, 5)).all()
    assert len(np.unique(whole)) == whole.size


def test_a_single_ray_is_uniform_over_its_shift():
    """Unbiased for any n: the mean over shifts of one ray is the mean over the hemisphere."""
    z = directions(1, n_points=20_000)[..., 2]
    # standard error sqrt(1/18 / 20,000) = 1.7e-3
    assert z.mean() == pytest.approx(2 / 3, abs=5e-3)
