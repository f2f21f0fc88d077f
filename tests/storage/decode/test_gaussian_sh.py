"""Gaussian lobes in spherical harmonics against scipy's Bessel functions and quadrature."""

import numpy as np
import pytest
from scipy.special import ive

from prtbake_storage.decode.gaussian_sh import gaussian_sh, scaled_bessel
from prtbake_storage.decode.light import LightFit
from prtbake_storage.decode.relight import project_light, rotation_matrix
from prtbake_storage.decode.sh import eval_sh
from prtbake_storage.decode.srbf import gaussian
from prtbake_storage.decode.transfer_basis import SphericalHarmonics
from prtbake_workers.basis.sh import rotate_sh
from support.quadrature import sphere_quadrature

ORDER = 9


def unit(rng, n):
    vectors = rng.standard_normal((n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.fixture
def light(rng):
    return LightFit(
        centres=unit(rng, 5),
        bandwidths=np.array([0.5, 3.0, 20.0, 60.0, 1.0]),
        coefficients=rng.normal(size=(5, 3)),
    )


@pytest.mark.parametrize("lam", [1e-3, 0.7, 12.0, 300.0, 2e5])
def test_scaled_bessel_functions_are_scipy_s(lam):
    degrees = np.arange(60)
    expected = np.sqrt(np.pi / (2.0 * lam)) * ive(degrees + 0.5, lam)
    # 2e-13: the product of 60 ratios, and as much of scipy's at large arguments
    np.testing.assert_allclose(scaled_bessel(60, [lam])[:, 0], expected, rtol=2e-13, atol=1e-300)


def test_bandwidths_do_not_disturb_each_other(rng):
    lams = np.array([1e-6, 2.0, 4e4])
    together = scaled_bessel(20, lams)
    apart = np.concatenate([scaled_bessel(20, [lam]) for lam in lams], axis=1)
    np.testing.assert_allclose(together, apart, rtol=1e-14, atol=1e-300)
    assert scaled_bessel(20, np.zeros(0)).shape == (20, 0)


def test_projected_lobes_are_integrals_with_every_function(light):
    directions, weights = sphere_quadrature(64)  # exact to rounding for the narrowest of 60
    radiance = gaussian(directions @ light.centres.T, light.bandwidths) @ light.coefficients
    expected = eval_sh(ORDER, directions).T @ (radiance * weights[:, None])
    basis = SphericalHarmonics(ORDER)
    found = project_light(basis, light)
    atol = 1e-12 * np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=atol)
    # negative twin: lobes a thousandth wider
    wider = basis.light_of_lobes(light.centres, 0.999 * light.bandwidths, light.coefficients)
    assert np.abs(wider - expected).max() > 1e6 * atol


def test_a_wide_lobe_is_its_own_series(light):
    """Bands beyond the lobe's add nothing: the projection evaluates to the lobe."""
    directions = unit(np.random.default_rng(1), 40)
    coefficients = gaussian_sh(20, light.centres[:2], light.bandwidths[:2])
    expected = gaussian(directions @ light.centres[:2].T, light.bandwidths[:2])
    np.testing.assert_allclose(eval_sh(20, directions) @ coefficients, expected, atol=1e-12)
    cut = eval_sh(3, directions) @ coefficients[:9]
    assert np.abs(cut - expected).max() > 1e-3


def test_turning_the_lobes_is_turning_the_coefficients(light):
    basis, rotation = SphericalHarmonics(ORDER), rotation_matrix((33.0, -70.0, 121.0))
    turned = project_light(basis, light, rotation)
    coefficients = project_light(basis, light)
    expected = rotate_sh(np.ascontiguousarray(coefficients.T), rotation).T
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    backwards = rotate_sh(np.ascontiguousarray(coefficients.T), rotation.T.copy()).T
    assert np.abs(turned - backwards).max() > 0.1


def test_centres_off_by_what_files_allow_are_taken_as_directions(light):
    exact = gaussian_sh(4, light.centres, light.bandwidths)
    np.testing.assert_allclose(
        gaussian_sh(4, 1.0005 * light.centres, light.bandwidths), exact, rtol=1e-12, atol=1e-14
    )
