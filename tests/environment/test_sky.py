"""The procedural sky: energy of the disc, place of the sun, colours, night."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.environment.sky import _sun_irradiance, sun_direction, sun_sky


def beam(width: int, elevation: float, azimuth: float):
    """What stands out of the sky around the sun: the disc's irradiance, and its direction."""
    sky = sun_sky(width, elevation, azimuth)
    weights, directions = sky.solid_angles(), sky.directions()
    bright = sky.radiance.reshape(-1, 3).astype(float)
    # the sky itself stays below 40 units everywhere, the disc is above 100
    disc = bright.max(axis=1) > 100
    irradiance = weights[disc] @ bright[disc]
    centre = (weights[disc] * bright[disc].sum(axis=1)) @ directions[disc]
    return irradiance, centre / np.linalg.norm(centre)


@pytest.mark.parametrize(("width", "azimuth"), [(256, 0.0), (512, 33.0), (1024, -120.0)])
def test_the_disc_has_the_suns_energy_at_any_resolution(width, azimuth) -> None:
    irradiance, centre = beam(width, 45.0, azimuth)
    # the sky behind the texels of the disc adds its own: at most 30 units times 5 texels
    assert irradiance == pytest.approx(_sun_irradiance(np.radians(45.0)), rel=0.12)
    # within a texel's half diagonal
    assert centre @ sun_direction(45.0, azimuth) > np.cos(np.pi / width * 2)


def test_azimuth_runs_from_the_middle_of_the_picture_to_the_right() -> None:
    assert sun_direction(0.0, 0.0) == pytest.approx([0, 0, -1], abs=1e-15)
    assert sun_direction(0.0, 90.0) == pytest.approx([1, 0, 0], abs=1e-15)
    assert sun_direction(90.0, 0.0) == pytest.approx([0, 1, 0], abs=1e-15)


def test_a_high_suns_sky_is_blue_and_a_low_sun_is_red() -> None:
    high = sun_sky(128, 60.0, 0.0)
    away = high.lookup(np.array([[0.0, 0.7, 0.7]]))[0]
    assert away[2] > 1.3 * away[0]
    low, noon = _sun_irradiance(np.radians(3.0)), _sun_irradiance(np.radians(60.0))
    assert low[0] / low[2] > 3 * noon[0] / noon[2]


@pytest.mark.parametrize("elevation", [-10.0, -1.0, 0.0, 0.3, 5.0, 90.0])
def test_every_elevation_gives_finite_light_that_falls_with_the_sun(elevation) -> None:
    here, higher = sun_sky(64, elevation, 10.0), sun_sky(64, min(elevation + 2, 90.0), 10.0)
    assert 0 < here.mean_radiance[1] <= higher.mean_radiance[1] * (1 + 1e-6)


def test_widths_and_elevations_out_of_range_are_refused() -> None:
    with pytest.raises(SettingsError, match="width 33"):
        sun_sky(33, 10.0, 0.0)
    with pytest.raises(SettingsError, match="sun_elevation_deg 91"):
        sun_sky(32, 91.0, 0.0)
