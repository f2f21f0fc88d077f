"""A procedural hall: dim walls, and small bright windows that hold most of the light."""

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.resampling import resample

# the hall as a box around the eye, in metres: x to the sides, y up, z along it
_LOWER = np.array([-6.0, -1.6, -18.0])
_UPPER = np.array([6.0, 8.4, 14.0])

_WINDOW_RADIANCE = np.array([60.0, 66.0, 78.0])
_LAMP_RADIANCE = np.array([240.0, 180.0, 105.0])
_FLOOR = (np.array([0.16, 0.10, 0.06]), np.array([0.07, 0.05, 0.04]))
_WALL = np.array([0.12, 0.105, 0.09])
_CEILING = np.array([0.05, 0.045, 0.04])

_WINDOW_PITCH = 4.0
_WINDOW_HALF_WIDTH = 0.45
_WINDOW_SILL, _WINDOW_TOP = 3.6, 6.4
_LAMP_PITCH = 8.0
_LAMP_RADIUS = 0.18


def hall(width: int) -> Environment:
    """Make the light inside a hall, seen from eye height near one end.

    High windows along the right wall and a row of lamps under the ceiling; the windows' share of
    the sphere is about 1 %, and together with the lamps they hold most of the power.

    Parameters
    ----------
    width
        Texels around the horizon, even; the height is half of it.
    """
    if width < 2 or width % 2:
        raise SettingsError(f"width {width} must be even and at least 2")
    # samples a third of a degree apart at most, or coarse maps would miss lamps
    supersample = max(4, 1024 // width)
    return Environment(resample(_radiance, width // 2, width, supersample=supersample))


def _radiance(directions: Float64[F64, "dirs 3"]) -> Float64[F64, "dirs 3"]:
    """Give what is seen in each direction: the box's wall, and what hangs on it."""
    with np.errstate(divide="ignore"):
        reach = np.where(directions > 0, _UPPER, _LOWER) / directions
    axis = np.argmin(np.abs(reach), axis=1)
    rows = np.arange(len(directions))
    places = directions * np.abs(reach[rows, axis])[:, None]
    x, y, z = places.T
    # walls grow darker with the distance from the windows' wall
    result = _WALL * (0.5 + 0.5 * (x - _LOWER[0]) / (_UPPER[0] - _LOWER[0]))[:, None]
    positive = directions[rows, axis] > 0
    chequered = (np.floor(x) + np.floor(z)) % 2 == 0
    floor = (axis == 1) & ~positive
    result[floor] = np.where(chequered[floor, None], _FLOOR[0], _FLOOR[1])
    ceiling = (axis == 1) & positive
    result[ceiling] = _CEILING
    window = (
        (axis == 0)
        & positive
        & (np.abs(_from_nearest(z, _WINDOW_PITCH)) < _WINDOW_HALF_WIDTH)
        & (y > _WINDOW_SILL)
        & (y < _WINDOW_TOP)
    )
    result[window] = _WINDOW_RADIANCE
    lamp = ceiling & (np.hypot(x, _from_nearest(z, _LAMP_PITCH)) < _LAMP_RADIUS)
    result[lamp] = _LAMP_RADIANCE
    return np.asarray(result)


def _from_nearest(position: Float64[F64, " dirs"], pitch: float) -> Float64[F64, " dirs"]:
    """Give the distance from the nearest of the places that repeat with a pitch."""
    return np.asarray(position - pitch * np.round(position / pitch))
