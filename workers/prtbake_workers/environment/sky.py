"""A procedural clear sky with a sun disc, after published formulas."""

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.environment import (
    Environment,
    directions_from_angles,
    lat_long_directions,
    lat_long_solid_angles,
    texel_of,
)

TURBIDITY = 3.0
"""A clear day; the model holds from 2 to 6."""

KILOCANDELA_PER_UNIT = 10.0
"""kcd / m^2 that make one unit of radiance: gives a mean of the order of 1 at noon."""

SUN_RADIUS_RAD = np.radians(0.2666)
"""Mean angular radius of the solar disc, 6.8e-5 sr."""

GROUND_ALBEDO = np.array([0.24, 0.22, 0.18])
"""Dry soil and grass, linear Rec.709."""

_SUN_POINTS = 64
"""Rings of the disc, and points on each: what a texel at its rim gets is good to 0.1 %."""

# Perez coefficients A to E of luminance Y and chromaticity x, y: slope with turbidity, intercept.
# [Preetham1999] appendix A.2
_PEREZ = {
    "Y": (
        (0.1787, -1.4630),
        (-0.3554, 0.4275),
        (-0.0227, 5.3251),
        (0.1206, -2.5771),
        (-0.0670, 0.3703),
    ),
    "x": (
        (-0.0193, -0.2592),
        (-0.0665, 0.0008),
        (-0.0004, 0.2125),
        (-0.0641, -0.8989),
        (-0.0033, 0.0452),
    ),
    "y": (
        (-0.0167, -0.2608),
        (-0.0950, 0.0092),
        (-0.0079, 0.2102),
        (-0.0441, -1.6537),
        (-0.0109, 0.0529),
    ),
}
# Zenith chromaticity: rows for T^2, T, 1; columns for theta^3, theta^2, theta, 1
_ZENITH = {
    "x": (
        (0.00166, -0.00375, 0.00209, 0.0),
        (-0.02903, 0.06377, -0.03202, 0.00394),
        (0.11693, -0.21196, 0.06052, 0.25886),
    ),
    "y": (
        (0.00275, -0.00610, 0.00317, 0.0),
        (-0.04214, 0.08970, -0.04153, 0.00516),
        (0.15346, -0.26756, 0.06670, 0.26688),
    ),
}
_XYZ_TO_RGB = np.array(
    [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
)
_RGB_WAVELENGTH_UM = np.array([0.61, 0.55, 0.465])


def sun_sky(width: int, sun_elevation_deg: float, sun_azimuth_deg: float) -> Environment:
    """Make a clear sky with sun over a plain ground.

    The sky is the model of [Preetham1999]_ at turbidity 3; the sun is a disc of the real size
    whose energy is spread over the texels it covers; the ground is diffuse and lit by both.  Below
    the horizon the sun is gone and the sky of a sun on the horizon fades tenfold every 3 degrees.

    Parameters
    ----------
    width
        Texels around the horizon, even; the height is half of it.
    sun_elevation_deg
        -90 to 90, above the horizon.
    sun_azimuth_deg
        From -z (the middle of the picture) towards +x.

    References
    ----------
    .. [Preetham1999] Preetham, Shirley, Smits: A Practical Analytic Model for Daylight.
    """
    if width < 2 or width % 2 or not -90.0 <= sun_elevation_deg <= 90.0:
        raise SettingsError(
            f"width {width} must be even and at least 2, sun_elevation_deg {sun_elevation_deg} "
            "from -90 to 90"
        )
    height = width // 2
    directions = lat_long_directions(height, width)
    solid_angles = lat_long_solid_angles(height, width)
    elevation = np.radians(max(sun_elevation_deg, 0.5))
    sun = sun_direction(float(np.degrees(elevation)), sun_azimuth_deg)
    fade = 10.0 ** min(0.0, sun_elevation_deg / 3.0)
    up = directions[:, 1] > 0
    radiance = np.zeros((height * width, 3))
    radiance[up] = fade * _preetham(directions[up], sun)
    irradiance = (radiance * (solid_angles * np.maximum(directions[:, 1], 0.0))[:, None]).sum(
        axis=0
    )
    if sun_elevation_deg > 0:
        beam = _sun_irradiance(elevation)
        irradiance += beam * np.sin(elevation)
        _add_disc(radiance, solid_angles, sun, beam, height, width)
    radiance[directions[:, 1] < 0] += GROUND_ALBEDO * irradiance / np.pi
    return Environment(radiance.reshape(height, width, 3).astype(np.float32))


def sun_direction(elevation_deg: float, azimuth_deg: float) -> Float64[F64, " 3"]:
    """Give the unit direction of an elevation and an azimuth (from -z towards +x)."""
    sine = np.array([np.sin(np.radians(elevation_deg))])
    return np.asarray(directions_from_angles(np.array([np.radians(azimuth_deg)]), sine)[0])


def _preetham(
    directions: Float64[F64, "dirs 3"], sun: Float64[F64, " 3"]
) -> Float64[F64, "dirs 3"]:
    """Evaluate the sky of [Preetham1999]_ eqs. (3) and (4) above the horizon, in our units."""
    theta_s = np.arccos(np.clip(sun[1], -1.0, 1.0))
    # the model divides by cos(theta): half a degree of haze above the horizon looks alike
    cos_theta = np.maximum(directions[:, 1], np.sin(np.radians(0.5)))
    gamma = np.arccos(np.clip(directions @ sun, -1.0, 1.0))
    t = TURBIDITY
    chi = (4.0 / 9.0 - t / 120.0) * (np.pi - 2.0 * theta_s)
    zenith = {"Y": (4.0453 * t - 4.9710) * np.tan(chi) - 0.2155 * t + 2.4192}
    powers = np.array([theta_s**3, theta_s**2, theta_s, 1.0])
    for name, rows in _ZENITH.items():
        zenith[name] = float(np.array([t * t, t, 1.0]) @ np.array(rows) @ powers)
    value = {}
    for name, coefficients in _PEREZ.items():
        a, b, c, d, e = (slope * t + intercept for slope, intercept in coefficients)
        here = (1 + a * np.exp(b / cos_theta)) * (
            1 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2
        )
        above = (1 + a * np.exp(b)) * (1 + c * np.exp(d * theta_s) + e * np.cos(theta_s) ** 2)
        value[name] = zenith[name] * here / above
    luminance = np.maximum(value["Y"], 0.0) / KILOCANDELA_PER_UNIT
    x, y = value["x"], np.maximum(value["y"], 1e-3)
    xyz = np.stack([luminance * x / y, luminance, luminance * (1 - x - y) / y], axis=1)
    return np.asarray(np.maximum(xyz @ _XYZ_TO_RGB.T, 0.0))


def _sun_irradiance(elevation_rad: float) -> Float64[F64, " 3"]:
    """Give the irradiance of the sun on a plane that faces it, in our units.

    128 klx outside the atmosphere, dimmed over the air mass of [KastenYoung1989] by Rayleigh
    scattering, 0.008735 wavelength^-4.08, and aerosol, 0.04 wavelength^-1.3 (micrometres).
    """
    degrees = np.degrees(elevation_rad)
    air_mass = 1.0 / (np.sin(elevation_rad) + 0.50572 * (degrees + 6.07995) ** -1.6364)
    depth = 0.008735 * _RGB_WAVELENGTH_UM**-4.08 + 0.04 * _RGB_WAVELENGTH_UM**-1.3
    return np.asarray(128.0 / KILOCANDELA_PER_UNIT * np.exp(-air_mass * depth))


def _add_disc(
    radiance: Float64[F64, "texels 3"],
    solid_angles: Float64[F64, " texels"],
    sun: Float64[F64, " 3"],
    irradiance: Float64[F64, " 3"],
    height: int,
    width: int,
) -> None:
    """Spread the sun's energy over the texels by points of equal solid angle on its disc."""
    height_of_ring = 1 - (1 - np.cos(SUN_RADIUS_RAD)) * (np.arange(_SUN_POINTS) + 0.5) / _SUN_POINTS
    turn = (np.arange(_SUN_POINTS) + 0.5) * (2 * np.pi / _SUN_POINTS)
    cosine, turn = (m.ravel() for m in np.meshgrid(height_of_ring, turn))
    side = np.cross(sun, [0.0, 0.0, 1.0] if abs(sun[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    sine = np.sqrt(1 - cosine**2)
    points = (
        cosine[:, None] * sun
        + (sine * np.cos(turn))[:, None] * side
        + (sine * np.sin(turn))[:, None] * np.cross(sun, side)
    )
    texels, counts = np.unique(texel_of(points, height, width), return_counts=True)
    share = counts / len(points)
    radiance[texels] += share[:, None] * irradiance / solid_angles[texels, None]
