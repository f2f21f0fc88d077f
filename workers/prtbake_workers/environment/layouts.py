"""Layouts of environment pictures: which one a picture has, and how it samples the sphere."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.arrays import B8, F32, F64, I64, Bool, Float32, Float64, Int64
from prtbake_workers.environment.environment import lat_long_solid_angles
from prtbake_workers.environment.picture import Picture
from prtbake_workers.environment.resampling import node_edges

PIXEL_LAYOUTS = ("lat_long", "lat_long_exr", "angular_probe", "cube_strip")
"""Names of the layouts that can be stated."""

_STATE = f"state the layout ({', '.join(PIXEL_LAYOUTS)}) when registering the environment"
_CUBE_FACES = (
    ((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
    ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0)),
)
"""The axes that point right and down in the faces +x -x +y -y +z -z of a cube strip."""

_BLACK_RIM_SHARE = 0.9
"""Share of the pixels outside the disc that is black in a probe; the rest is a line of credits."""


@dataclass(frozen=True)
class Layout:
    """How a picture of a layout samples the sphere.

    ``solid_angles`` of all pixels sum to about 4 pi, with zero for pixels that see nothing;
    ``pixel_of`` maps unit directions to flat pixel indices, and is None for the two lat-long
    layouts, which are box filtered exactly; ``lat_long_width`` is the internal width that keeps
    the resolution.
    """

    name: str
    solid_angles: Float64[F64, " pixels"]
    lat_long_width: int
    pixel_of: Callable[[F64], I64] | None = None


def recognise_layout(picture: Picture, filename: str | None) -> tuple[str, str]:
    """Recognise the layout of a picture, or refuse to guess.

    Returns
    -------
    name, evidence
        One of ``PIXEL_LAYOUTS`` and what it was recognised by.
    """
    height, width = picture.pixels.shape[:2]
    if picture.layout_attribute is not None:
        return picture.layout_attribute, "the envmap attribute of the file"
    if width == 2 * height:
        return "lat_long", "the aspect ratio 2:1"
    if height == 6 * width:
        return "cube_strip", "the aspect ratio 1:6"
    if width == height:
        stem = (filename or "").rpartition("/")[2].rpartition(".")[0].lower()
        if stem.endswith("probe") and _rim_is_black(picture.pixels):
            return "angular_probe", "the file name and the black rim"
        raise EnvironmentMapError(
            f"a square picture ({width} x {height}) can be an angular probe, a mirror sphere or no "
            f"environment at all: {_STATE}; a mirror-sphere picture has to be unwrapped first",
            pointer="/layout",
        )
    raise EnvironmentMapError(
        f"a picture of {width} x {height} is none of lat-long (2:1), cube strip (1:6) and angular "
        f"probe (1:1): {_STATE}",
        pointer="/layout",
    )


def layout_of(name: str, height: int, width: int) -> Layout:
    """Give the sampling of a layout at a picture's size.

    Raises
    ------
    EnvironmentMapError
        If the size does not fit the layout.
    """
    shape, layout = {
        "lat_long": (width == 2 * height, _lat_long),
        "lat_long_exr": (width == 2 * height, _lat_long_exr),
        "angular_probe": (width == height, _angular_probe),
        "cube_strip": (height == 6 * width, _cube_strip),
    }[name]
    if not shape:
        ratio = {"angular_probe": "1:1", "cube_strip": "1:6"}.get(name, "2:1")
        raise EnvironmentMapError(
            f"layout {name} needs a picture of {ratio}, this one is {width} x {height}",
            pointer="/layout",
        )
    return layout(height, width)


def _lat_long(height: int, width: int) -> Layout:
    return Layout("lat_long", lat_long_solid_angles(height, width), width)


def _lat_long_exr(height: int, width: int) -> Layout:
    """Follow OpenEXR's rule u = 0.5 - atan2(x, z) / (2 pi), pixel centres on the map's edges."""
    rows = np.diff(np.cos(node_edges(height) * np.pi))
    columns = np.diff(node_edges(width)) * 2 * np.pi
    return Layout("lat_long_exr", -np.outer(rows, columns).ravel(), width)


def _angular_probe(height: int, width: int) -> Layout:
    """Radius r in the unit disc shows the angle pi r from -z; x is right, y up."""

    def pixel_of(directions: F64) -> I64:
        angle = np.arccos(np.clip(-directions[:, 2], -1.0, 1.0))
        across = np.hypot(directions[:, 0], directions[:, 1])
        # at the two poles of the probe the radius is 0 or 1 and any side of it will do
        scale = angle / np.pi / np.maximum(across, 1e-12)
        column = (directions[:, 0] * scale + 1) * (width / 2)
        row = (1 - directions[:, 1] * scale) * (height / 2)
        return _clamped(row, height) * width + _clamped(column, width)

    u, v = np.meshgrid(
        (np.arange(width) + 0.5) * (2 / width) - 1, (np.arange(height) + 0.5) * (2 / height) - 1
    )
    radius = np.hypot(u, v)
    solid_angles = np.where(
        radius <= 1, np.pi**2 * np.sinc(radius) * (2 / width) * (2 / height), 0.0
    )
    return Layout("angular_probe", solid_angles.ravel(), 2 * ((width + 1) // 2), pixel_of)


def _cube_strip(height: int, width: int) -> Layout:
    """Six faces from top to bottom, +x -x +y -y +z -z, placed as OpenEXR's ImfEnvmap says.

    The outer pixel centres of a face lie on the edges of the cube, so its outer cells are half
    cells and the edge pixels of two faces show the same place.
    """
    size = width

    def pixel_of(directions: F64) -> I64:
        axis = np.argmax(np.abs(directions), axis=1)
        along = np.take_along_axis(directions, axis[:, None], axis=1)[:, 0]
        faces = 2 * axis + (along < 0)
        pixels = np.empty(len(directions), dtype=np.int64)
        for face, (right, down) in enumerate(_CUBE_FACES):
            inside = np.flatnonzero(faces == face)
            scale = (size - 1) / 2 / np.abs(along[inside])
            offset = (size - 1) / 2 + 0.5
            column = _clamped(directions[inside] @ np.array(right) * scale + offset, size)
            row = _clamped(directions[inside] @ np.array(down) * scale + offset, size)
            pixels[inside] = (face * size + row) * size + column
        return pixels

    edges = 2 * node_edges(size) - 1
    # solid angle of the corner rectangle [0, a] x [0, b] on the plane at distance 1
    corner = np.arctan2(
        edges[:, None] * edges[None, :], np.sqrt(edges[:, None] ** 2 + edges[None, :] ** 2 + 1)
    )
    cells = corner[1:, 1:] - corner[:-1, 1:] - corner[1:, :-1] + corner[:-1, :-1]
    return Layout("cube_strip", np.tile(cells.ravel(), 6), 4 * size, pixel_of)


def _clamped(position: Float64[F64, " dirs"], size: int) -> Int64[I64, " dirs"]:
    """Give the cell of a position, with the far edge in the last cell."""
    return np.clip(np.floor(position).astype(np.int64), 0, size - 1)


def _rim_is_black(pixels: Float32[F32, "height width 3"]) -> bool:
    """Tell whether most of what lies outside the inscribed disc is black."""
    outside = _outside_disc(pixels.shape[0])
    return bool((pixels[outside] == 0).all(axis=1).mean() >= _BLACK_RIM_SHARE)


def _outside_disc(size: int) -> Bool[B8, "size size"]:
    """Mask the pixels that lie outside the disc by more than a pixel."""
    offset = (np.arange(size) + 0.5) * (2 / size) - 1
    outside = np.hypot(offset[:, None], offset[None, :]) > 1 + 2 / size
    return np.asarray(outside)
