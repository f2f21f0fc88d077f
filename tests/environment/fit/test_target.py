"""Fits that meet a given error, from coarse to fine, and targets that cannot be met."""

import numpy as np
import pytest

from prtbake_storage.decode.light import LightFit
from prtbake_storage.errors import SettingsError
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit import fit_environment, fit_to_error
from prtbake_workers.environment.fit.cells import FitSamples, environment_texels
from prtbake_workers.environment.fit.growth import grow
from prtbake_workers.environment.fit.objective import Lobes
from prtbake_workers.environment.fit.scattered import with_coefficients
from prtbake_workers.environment.light_error import squared_error_ratio
from prtbake_workers.environment.procedural import constant, one_texel_sun
from prtbake_workers.environment.sky import sun_sky


@pytest.fixture(scope="module")
def sky():
    return sun_sky(64, 40.0, 30.0)


def test_a_target_is_met_by_more_lobes_than_leave_more(sky):
    fit = fit_to_error(sky, 0.1, most_lobes=200, seed=0, max_iterations=2)
    assert fit.error <= 0.1
    trace = list(fit.errors.values())
    assert trace[-1] == fit.error
    assert all(error > 0.1 for error in trace[:-1])
    assert list(fit.errors)[-1] == f"{len(fit.centres)} lobes"
    # the error is that of the light itself, over the sphere
    light = LightFit(centres=fit.centres, bandwidths=fit.bandwidths, coefficients=fit.coefficients)
    # and holds between the samples that it was taken in
    other = environment_texels(sky, 34)
    assert squared_error_ratio(light, other) == pytest.approx(fit.error, rel=0.02)


def test_a_tighter_target_takes_more_lobes(sky):
    counts = [
        len(fit_to_error(sky, error, most_lobes=200, seed=0, max_iterations=1).centres)
        for error in (0.3, 0.1)
    ]
    assert counts[0] < counts[1]


def test_an_easy_target_takes_the_first_fit():
    fit = fit_to_error(constant(16, 1.0), 0.5, most_lobes=200, seed=0)
    assert len(fit.centres) == 12


def test_a_target_out_of_reach_says_what_was_reached(rng):
    speckled = Environment(rng.random((16, 32, 3)).astype(np.float32) ** 4)
    with pytest.raises(SettingsError, match=r"max_error 0\.001 cannot be met: 20 lobes, of") as it:
        fit_to_error(speckled, 1e-3, most_lobes=20, seed=0, max_iterations=1)
    assert it.value.pointer == "/settings/max_error"
    # few texels are a limit as well
    few = Environment(speckled.radiance[:4, :8])
    with pytest.raises(SettingsError, match="cannot be met: 32 lobes, of at most 100"):
        fit_to_error(few, 1e-13, most_lobes=100, seed=0, max_iterations=1)


@pytest.mark.parametrize("target", [0.0, -0.1, 1.0, np.nan])
def test_targets_that_are_no_share_are_refused(target):
    with pytest.raises(SettingsError, match="between 0 and 1"):
        fit_to_error(constant(8), target, most_lobes=20, seed=0)


def test_equal_arguments_give_equal_bytes(sky):
    first, second = (
        fit_to_error(sky, 0.3, most_lobes=60, seed=4, max_iterations=1) for _ in range(2)
    )
    for a, b in zip(first[:3], second[:3], strict=True):
        assert a.tobytes() == b.tobytes()


def test_lobes_that_are_added_lower_the_error(sky):
    texels = environment_texels(sky)
    start = fit_environment(sky, 8, seed=0, max_iterations=1)
    lobes = grow(texels, Lobes(start.centres, start.bandwidths), 16, max_steps=10)
    assert len(lobes.bandwidths) == 16
    grown = with_coefficients(
        lobes, FitSamples(*[texels] * 3), n_peak_lobes=start.n_peak_lobes, errors={}
    )
    assert grown.error < 0.8 * start.error
    # negative twin: as many lobes, the new ones all where one is already
    copied = Lobes(
        np.concatenate([start.centres, start.centres]),
        np.concatenate([start.bandwidths, 0.99 * start.bandwidths]),
    )
    other = with_coefficients(
        copied, FitSamples(*[texels] * 3), n_peak_lobes=start.n_peak_lobes, errors={}
    )
    assert other.error > grown.error


def test_a_sun_that_the_first_lobes_blur_gets_narrow_ones():
    """One texel, 1e4 times as bright as the sky: lobes as narrow as it, where it is."""
    sun = one_texel_sun(128)
    assert sun.luminance.max() > 1e3
    assert sun.luminance.max() / np.median(sun.luminance) > 1e4
    fit = fit_to_error(sun, 0.1, most_lobes=60, seed=0, max_iterations=1)
    brightest = sun.directions()[int(np.argmax(sun.luminance))]
    width = np.pi / sun.height
    near = fit.centres @ brightest > np.cos(2.0 * width)
    assert near.any()
    # a Gaussian of a square's width: standard deviation 1 / sqrt(lam) below half of the texel
    assert fit.bandwidths[near].max() > (2.0 / width) ** 2
    assert fit.power_ratio == pytest.approx(1.0, abs=0.01)
