"""Environments that need no file."""

import numpy as np

from prtbake_storage.contract.resources import BuiltinEnvironment
from prtbake_storage.errors import SettingsError
from prtbake_workers.environment.environment import (
    Environment,
    lat_long_solid_angles,
    texel_of,
)
from prtbake_workers.environment.hall import hall
from prtbake_workers.environment.sky import sun_direction, sun_sky


def builtin(settings: BuiltinEnvironment) -> Environment:
    """Make the procedural environment that the settings name."""
    match settings.name:
        case "sun_sky":
            return sun_sky(settings.width, settings.sun_elevation_deg, settings.sun_azimuth_deg)
        case "hall":
            return hall(settings.width)
        case "constant":
            return constant(settings.width)
        case "one_texel_sun":
            return one_texel_sun(
                settings.width,
                sun_elevation_deg=settings.sun_elevation_deg,
                sun_azimuth_deg=settings.sun_azimuth_deg,
            )


def constant(width: int, radiance: float = 1.0) -> Environment:
    """Make an environment of one radiance everywhere: the furnace test's light."""
    _check_width(width)
    return Environment(np.full((width // 2, width, 3), radiance, dtype=np.float32))


def one_texel_sun(
    width: int,
    *,
    sun_elevation_deg: float = 40.0,
    sun_azimuth_deg: float = 30.0,
    sun_irradiance: float = np.pi,
    sky_radiance: float = 0.05,
) -> Environment:
    """Make a dim even sky with all of the sun in the one texel that holds its direction.

    The sun's irradiance (radiance times solid angle) does not depend on the width.
    """
    _check_width(width)
    height = width // 2
    radiance = np.full((height * width, 3), sky_radiance)
    sun = sun_direction(sun_elevation_deg, sun_azimuth_deg)
    texel = int(texel_of(sun[None, :], height, width)[0])
    radiance[texel] += sun_irradiance / lat_long_solid_angles(height, width)[texel]
    return Environment(radiance.reshape(height, width, 3).astype(np.float32))


def _check_width(width: int) -> None:
    if width < 2 or width % 2:
        raise SettingsError(f"width {width} must be even and at least 2", pointer="/builtin/width")
