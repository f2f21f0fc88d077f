"""Environments without a file."""

import numpy as np
import pytest

from prtbake_storage.contract.resources import BuiltinEnvironment
from prtbake_storage.errors import SettingsError
from prtbake_workers.environment.hall import hall
from prtbake_workers.environment.procedural import builtin, constant, one_texel_sun
from prtbake_workers.environment.report import light_statistics


@pytest.mark.parametrize("name", ["sun_sky", "hall", "constant", "one_texel_sun"])
def test_every_builtin_is_made_at_its_width_and_twice_alike(name) -> None:
    settings = BuiltinEnvironment(name=name, width=32)
    first, second = builtin(settings), builtin(settings)
    assert (first.width, first.height) == (32, 16)
    assert first.radiance.tobytes() == second.radiance.tobytes()
    assert first.mean_radiance.min() > 0


@pytest.mark.parametrize("width", [16, 64, 250])
def test_the_one_texel_sun_has_the_same_irradiance_at_any_width(width) -> None:
    sun = one_texel_sun(width, sun_irradiance=2.0, sky_radiance=0.5)
    excess = sun.mean_radiance * 4 * np.pi - 0.5 * 4 * np.pi
    # float32 radiance of one texel
    assert excess == pytest.approx([2.0] * 3, rel=1e-5)
    assert (sun.radiance > 0.5).all(axis=2).sum() == 1


def test_a_constant_environment_is_constant() -> None:
    assert (constant(16, 3.0).radiance == 3.0).all()


def test_the_halls_windows_hold_most_of_its_light_and_little_of_its_sphere() -> None:
    light = hall(128)
    luminance, weights = light.luminance.ravel(), light.solid_angles()
    bright = luminance > 10
    assert weights[bright].sum() / (4 * np.pi) < 0.02
    assert (weights * luminance)[bright].sum() > 0.7 * (weights * luminance).sum()
    # the windows are on the right wall
    assert (weights * luminance * light.directions()[:, 0]).sum() > 0
    # supersampling lets the light depend little on the resolution: windows are 4 texels wide
    assert hall(64).mean_radiance == pytest.approx(light.mean_radiance, rel=0.02)


def test_statistics_tell_how_concentrated_the_light_is() -> None:
    even = light_statistics(constant(64))
    assert even["power_in_brightest_thousandth"] == pytest.approx(1e-3, rel=0.1)
    assert even["max_luminance"] == pytest.approx(even["median_luminance"])
    sun = light_statistics(one_texel_sun(64, sun_irradiance=9.0, sky_radiance=1 / (4 * np.pi)))
    assert sun["power_in_brightest_thousandth"] == pytest.approx(0.9, abs=0.01)
    assert light_statistics(constant(64, 0.0))["black_share"] == pytest.approx(1.0)


@pytest.mark.parametrize("make", [hall, constant, one_texel_sun])
def test_odd_widths_are_refused(make) -> None:
    with pytest.raises(SettingsError, match="width 15"):
        make(15)
