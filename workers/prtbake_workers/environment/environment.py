"""The internal form of distant light: a lat-long map that is constant over each texel."""

from dataclasses import dataclass

import numpy as np

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.arrays import F32, F64, I64, Float32, Float64, Int64

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec.709 weights of the luminance in linear R, G, B."""


@dataclass(frozen=True)
class Environment:
    """Distant light as a lat-long map; the light *is* its texels, each of one radiance.

    The texel of a direction d (unit, y up) is found from u = 0.5 + atan2(x, -z) / (2 pi) and
    v = acos(y) / pi, with v = 0 up; row v, column u.

    Parameters
    ----------
    radiance
        Linear Rec.709 radiance in W / (sr m^2) up to a common scale, finite and not negative.

    Raises
    ------
    EnvironmentMapError
        If the map is empty or a value is negative or not finite; names the first texel.
    """

    radiance: Float32[F32, "height width 3"]

    def __post_init__(self) -> None:
        if min(self.radiance.shape[:2]) < 1:
            raise EnvironmentMapError("the environment map has no texels")
        bad = ~(np.isfinite(self.radiance) & (self.radiance >= 0))
        if bad.any():
            y, x, channel = (int(i) for i in np.argwhere(bad)[0])
            raise EnvironmentMapError(
                f"texel (x={x}, y={y}) channel {channel} is {self.radiance[y, x, channel]}: "
                "radiance is finite and not negative"
            )

    @property
    def height(self) -> int:
        """Number of rows."""
        return int(self.radiance.shape[0])

    @property
    def width(self) -> int:
        """Number of columns."""
        return int(self.radiance.shape[1])

    def directions(self) -> Float64[F64, "texels 3"]:
        """Give the unit directions of the texel centres, rows from the top, left to right."""
        return lat_long_directions(self.height, self.width)

    def solid_angles(self) -> Float64[F64, " texels"]:
        """Give the exact solid angles of the texels in sr; they sum to 4 pi."""
        return lat_long_solid_angles(self.height, self.width)

    def lookup(self, directions: Float64[F64, "dirs 3"]) -> Float64[F64, "dirs 3"]:
        """Give the radiance of the texel that each unit direction falls in."""
        texels = texel_of(directions, self.height, self.width)
        return self.radiance.reshape(-1, 3)[texels].astype(np.float64)

    @property
    def luminance(self) -> Float64[F64, "height width"]:
        """Rec.709 luminance of the texels."""
        return np.asarray(self.radiance.astype(np.float64) @ LUMINANCE)

    @property
    def mean_radiance(self) -> Float64[F64, " 3"]:
        """Solid-angle weighted mean over the sphere, per channel."""
        flat = self.radiance.reshape(-1, 3).astype(np.float64)
        return np.asarray(self.solid_angles() @ flat / (4 * np.pi))


def lat_long_directions(height: int, width: int) -> Float64[F64, "texels 3"]:
    """Give the directions of the texel centres of a lat-long map, rows from the top."""
    azimuth = (np.arange(width) + 0.5) / width * 2 * np.pi - np.pi
    polar = (np.arange(height) + 0.5) / height * np.pi
    return directions_from_angles(
        np.broadcast_to(azimuth, (height, width)).ravel(),
        np.repeat(np.cos(polar), width),
    )


def directions_from_angles(
    azimuth_rad: Float64[F64, " dirs"], cos_polar: Float64[F64, " dirs"]
) -> Float64[F64, "dirs 3"]:
    """Give directions from the azimuth (0 at -z, growing towards +x) and the height y."""
    horizontal = np.sqrt(np.maximum(0.0, 1.0 - cos_polar**2))
    return np.stack(
        [horizontal * np.sin(azimuth_rad), cos_polar, -horizontal * np.cos(azimuth_rad)], axis=1
    )


def lat_long_solid_angles(height: int, width: int) -> Float64[F64, " texels"]:
    """Integrate sin(theta) over each texel exactly: a row's band divided by its texels."""
    edges = np.cos(np.arange(height + 1) / height * np.pi)
    return np.repeat((edges[:-1] - edges[1:]) * (2 * np.pi / width), width)


def texel_of(directions: Float64[F64, "dirs 3"], height: int, width: int) -> Int64[I64, " dirs"]:
    """Give the flat index (row * width + column) of the texel of each unit direction."""
    u = 0.5 + np.arctan2(directions[:, 0], -directions[:, 2]) / (2 * np.pi)
    v = np.arccos(np.clip(directions[:, 1], -1.0, 1.0)) / np.pi
    # u = 1 is the same place as u = 0; v = 1 is the south pole and belongs to the last row
    column = np.floor(u * width).astype(np.int64) % width
    row = np.minimum((v * height).astype(np.int64), height - 1)
    return row * width + column
