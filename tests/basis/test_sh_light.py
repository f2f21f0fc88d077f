"""Spherical-harmonic light against closed forms."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.legendre import gaussian_legendre
from prtbake_workers.basis.sh import eval_sh, rotate_sh, sh_light
from prtbake_workers.basis.srbf import gaussian
from prtbake_workers.environment.environment import lat_long_directions, lat_long_solid_angles
from support.quadrature import sphere_quadrature

AXIS = np.array([0.48, 0.6, 0.64])
COLOUR = np.array([1.0, 0.5, 0.25])


@pytest.fixture(scope="module")
def texels():
    return lat_long_directions(96, 192), lat_long_solid_angles(96, 192)


def zonal(order, factors):
    """Funk and Hecke: f(d . axis) has the coefficients factor_l y_lm(axis)."""
    degrees = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    return np.asarray(factors)[degrees] * eval_sh(order, AXIS[None])[0]


def test_constant(texels):
    light = sh_light(6, *texels, np.tile(COLOUR, (len(texels[0]), 1)))
    expected = np.zeros((36, 3))
    expected[0] = np.sqrt(4 * np.pi) * COLOUR
    # 1e-3: texel centres are a rule of second order
    np.testing.assert_allclose(light, expected, rtol=0, atol=1e-3)
    np.testing.assert_allclose(light[0], expected[0], rtol=1e-12)


def test_delta(texels):
    directions, solid_angles = texels
    radiance = np.zeros((len(directions), 3))
    radiance[1234] = COLOUR / solid_angles[1234]
    light = sh_light(8, directions, solid_angles, radiance)
    np.testing.assert_allclose(light, eval_sh(8, directions[1234:1235]).T * COLOUR, rtol=1e-13)
    assert np.abs(light - eval_sh(8, directions[1235:1236]).T * COLOUR).max() > 0.01


def cosine_lobe_factors(order):
    """pi, 2 pi / 3, pi / 4, 0, -pi / 24, ...: integrals of max(0, t) P_l(t) times 2 pi."""
    nodes, weights = np.polynomial.legendre.leggauss(order + 1)
    t, weights = 0.5 * (nodes + 1), 0.5 * weights
    return [
        2 * np.pi * weights @ (t * np.polynomial.legendre.Legendre.basis(n)(t))
        for n in range(order)
    ]


def test_cosine_lobe(texels):
    directions, solid_angles = texels
    factors = cosine_lobe_factors(7)
    known = [np.pi, 2 * np.pi / 3, np.pi / 4, 0, -np.pi / 24]
    np.testing.assert_allclose(factors[:5], known, rtol=0, atol=1e-14)
    radiance = np.maximum(0.0, directions @ AXIS)[:, None] * COLOUR
    light = sh_light(7, directions, solid_angles, radiance)
    expected = zonal(7, factors)[:, None] * COLOUR
    # 1e-3: the kink at the horizon on texels of 2 degrees; 3e-4 measured
    np.testing.assert_allclose(light, expected, rtol=0, atol=1e-3)
    unweighted = sh_light(
        7, directions, np.full(len(directions), 4 * np.pi / len(directions)), radiance
    )
    assert np.abs(unweighted - expected).max() > 0.05


def test_gaussian_lobe_equals_its_legendre_series():
    directions, weights = sphere_quadrature(60)
    lobe = gaussian(directions @ AXIS, 30.0)[:, None] * COLOUR
    light = sh_light(20, directions, weights, lobe)
    factors = gaussian_legendre(30.0, 20) * 4 * np.pi / (2 * np.arange(20) + 1)
    # 1e-13: rounding of the 7,200 points of a rule that has converged
    np.testing.assert_allclose(light, zonal(20, factors)[:, None] * COLOUR, rtol=0, atol=1e-13)


def test_turned_light_is_the_light_of_the_turned_environment(rng):
    directions, weights = sphere_quadrature(12)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    coeffs = rng.normal(size=(49, 3))
    light = sh_light(7, directions, weights, eval_sh(7, directions) @ coeffs)
    np.testing.assert_allclose(light, coeffs, rtol=0, atol=1e-13)
    turned = sh_light(7, directions, weights, eval_sh(7, directions @ rotation) @ coeffs)
    np.testing.assert_allclose(rotate_sh(light.T, rotation).T, turned, rtol=0, atol=1e-13)
    assert np.abs(rotate_sh(light.T, rotation.T).T - turned).max() > 0.1


def test_blocks_of_texels_do_not_show(texels, monkeypatch):
    directions, solid_angles = texels
    radiance = np.maximum(0.0, directions)
    whole = sh_light(5, directions, solid_angles, radiance)
    monkeypatch.setattr("prtbake_workers.basis.sh_light.LIGHT_VALUES", 25 * 1000)
    blocks = sh_light(5, directions, solid_angles, radiance)
    np.testing.assert_allclose(blocks, whole, rtol=0, atol=1e-13)


def test_solid_angles_that_leave_a_part_out_are_refused(texels):
    directions, solid_angles = texels
    with pytest.raises(SettingsError, match=r"must sum to 4 pi, got 12\.5"):
        sh_light(3, directions[:-192], solid_angles[:-192], np.ones((len(directions) - 192, 3)))
