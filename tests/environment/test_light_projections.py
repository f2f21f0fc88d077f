"""Harmonics, uniform SRBFs and wavelets of a light: closed forms, optimality, refusals."""

import numpy as np
import pytest

from prtbake_storage.decode.cube_map import cube_texels
from prtbake_storage.decode.gaussian_sh import gaussian_sh
from prtbake_storage.decode.light import HarmonicLight, LightFit, WaveletLight
from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import Cells
from prtbake_workers.environment.light_error import power_ratio, squared_error_ratio
from prtbake_workers.environment.procedural import constant
from prtbake_workers.environment.sh_projection import project_sh, sh_samples
from prtbake_workers.environment.uniform_srbf import fit_uniform_srbf, uniform_samples
from prtbake_workers.environment.wavelet_projection import (
    cube_map_of,
    project_wavelet,
    wavelet_samples,
)
from prtbake_workers.geometry.icosphere import icosphere
from support.quadrature import random_directions, sphere_quadrature

COLOURS = np.array([[1.0, 0.5, 0.2], [2.0, 2.0, 3.0], [0.5, 4.0, 1.0]])


def samples_of(light, n=40):
    directions, weights = sphere_quadrature(n)
    return Cells(directions, light.radiance(directions), weights)


@pytest.fixture
def lobes(rng):
    return LightFit(
        centres=random_directions(rng, 3),
        bandwidths=np.array([2.0, 6.0, 1.0]),
        coefficients=COLOURS,
    )


@pytest.fixture
def speckled(rng):
    """A map of random texels: every method leaves much of it."""
    return Environment((rng.random((16, 32, 3)) ** 3).astype(np.float32))


def fits(environment):
    """One light of every method with the samples that it was fitted to."""
    sh, uniform = sh_samples(environment, 5), uniform_samples(environment, 42, None)
    cube = wavelet_samples(environment, 8)
    return {
        "sh": (project_sh(sh, 5), sh),
        "uniform": (fit_uniform_srbf(uniform, 42), uniform),
        "wavelet": (project_wavelet(cube, 8, 42), cube),
    }


def test_harmonics_of_lobes_are_their_closed_form(lobes):
    found = project_sh(samples_of(lobes), 6)
    expected = gaussian_sh(6, lobes.centres, lobes.bandwidths) @ lobes.coefficients
    np.testing.assert_allclose(found.coefficients, expected, atol=1e-11)
    # what is left is what the higher degrees hold
    rest = gaussian_sh(30, lobes.centres, lobes.bandwidths) @ lobes.coefficients
    energy = (rest**2).sum()
    assert found.error == pytest.approx((rest[36:] ** 2).sum() / energy, rel=1e-6)


def test_uniform_lobes_are_found_again(rng):
    coefficients = rng.normal(size=(42, 3))
    lam = default_bandwidth(42)
    light = LightFit(centres=icosphere(1), bandwidths=np.full(42, lam), coefficients=coefficients)
    found = fit_uniform_srbf(samples_of(light), 42)
    assert found.method == "srbf_uniform"
    # the ridge of 1e-6 against the least eigenvalue of the Gram matrix of unit lobes, 1e-3
    np.testing.assert_allclose(found.coefficients, coefficients, atol=5e-3)
    assert found.error < 1e-5
    other = fit_uniform_srbf(samples_of(light), 42, 3.0 * lam)
    assert other.bandwidths == pytest.approx(3.0 * lam)
    assert other.error > 100 * found.error


def test_a_bandwidth_whose_gram_matrix_is_singular_is_still_solved():
    """A furnace of lobes as wide as the sphere: 162 of them are nearly one function."""
    environment = constant(16, 2.0)
    fit = fit_uniform_srbf(uniform_samples(environment, 162, 0.1), 162, 0.1)
    assert np.isfinite(fit.coefficients).all()
    assert fit.error < 1e-6


@pytest.mark.parametrize("method", ["sh", "uniform", "wavelet"])
def test_no_other_coefficients_leave_less(rng, speckled, method):
    light, texels = fits(speckled)[method]
    assert 0.2 < light.error < 1.0
    assert light.error == squared_error_ratio(light, texels)
    for scale in (1e-2, -1e-2):
        step = rng.normal(size=light.coefficients.shape) * scale * np.abs(light.coefficients).max()
        moved = type(light)(**{**vars_of(light), "coefficients": light.coefficients + step})
        assert squared_error_ratio(moved, texels) > light.error


def vars_of(light):
    return {name: getattr(light, name) for name in light.__dataclass_fields__}


@pytest.mark.parametrize("method", ["sh", "uniform", "wavelet"])
def test_a_constant_light_is_exact_and_has_its_power(method):
    light, texels = fits(constant(32, 2.0))[method]
    # samples in the middle of their pieces; uniform lobes up to their ripple
    assert light.error < {"sh": 1e-7, "uniform": 1e-4, "wavelet": 1e-28}[method]
    assert power_ratio(light, texels) == pytest.approx(1.0, rel=1e-3)


@pytest.mark.parametrize("method", ["sh", "uniform", "wavelet"])
def test_a_black_light_is_fitted_by_black(method):
    light, texels = fits(Environment(np.zeros((8, 16, 3), np.float32)))[method]
    assert light.error == 0.0
    assert not light.coefficients.any()
    assert power_ratio(light, texels) == 1.0
    assert squared_error_ratio(HarmonicLight(coefficients=np.ones((1, 3))), texels) == np.inf


def test_more_functions_leave_less(speckled):
    samples = sh_samples(speckled, 8)
    assert project_sh(samples, 8).error < project_sh(samples, 4).error
    cube = wavelet_samples(speckled, 8)
    errors = [project_wavelet(cube, 8, n).error for n in (6, 60, 384)]
    assert errors[0] > errors[1] > errors[2]
    # negative twin of the choice: the first 60 instead of the largest
    best = project_wavelet(cube, 8, 60)
    whole = project_wavelet(cube, 8, 384)
    first = WaveletLight(
        resolution=8, indices=whole.indices[:60], coefficients=whole.coefficients[:60]
    )
    assert squared_error_ratio(first, cube) > best.error


def test_a_cube_map_comes_back_from_all_its_wavelets(rng):
    """Samples that are the parts of a cube map's texels: nothing is left."""
    directions, solid_angles, owners = cube_texels(4, 2)
    radiance = rng.random((96, 3))
    texels = Cells(directions, radiance[owners], solid_angles)
    np.testing.assert_allclose(cube_map_of(texels, 4), radiance, rtol=1e-14)
    light = project_wavelet(texels, 4, 96)
    assert light.error < 1e-28
    np.testing.assert_allclose(light.texels, radiance, atol=1e-13)


@pytest.mark.parametrize("resolution", [16, 64])
def test_a_cube_map_finer_than_the_map_has_no_empty_texel(resolution):
    texels = wavelet_samples(constant(4), resolution)
    np.testing.assert_allclose(cube_map_of(texels, resolution), 1.0)


def test_settings_out_of_range_are_refused(speckled):
    texels = wavelet_samples(speckled, 4)
    with pytest.raises(SettingsError, match="n_wavelets is 97"):
        project_wavelet(texels, 4, 97)
    with pytest.raises(SettingsError, match="resolution is 6"):
        project_wavelet(texels, 6, 10)
    few = Cells(*(part[:50] for part in texels))
    with pytest.raises(SettingsError, match="holds no sample"):
        project_wavelet(few, 4, 10)
    with pytest.raises(SettingsError, match="n_centres is 100"):
        fit_uniform_srbf(texels, 100)
    with pytest.raises(SettingsError, match="bandwidth is 0"):
        fit_uniform_srbf(texels, 42, 0.0)
    with pytest.raises(ValueError, match="order is 101"):
        project_sh(texels, 101)
