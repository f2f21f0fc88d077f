"""Pinhole cameras: framing, rays through pixel centres, and the matrix that agrees with them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.settings import Camera
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64

MARGIN = 1.08
"""Air that automatic framing leaves around the object."""

PARALLEL = 1e-6
"""Sine of the angle between view and up below which there is no way to tell which side is right."""


@dataclass(frozen=True)
class Pinhole:
    """A camera with everything decided.

    ``right``, ``up``, ``back`` are unit world vectors (back points from the target to the eye);
    ``tan_x``, ``tan_y`` are the half extents of the picture at distance 1.
    """

    eye: Float64[F64, " xyz"]
    right: Float64[F64, " xyz"]
    up: Float64[F64, " xyz"]
    back: Float64[F64, " xyz"]
    tan_x: float
    tan_y: float

    def directions(self, width: int, height: int) -> Float64[F64, "rays 3"]:
        """Return unit directions through the pixel centres, row by row from the upper left."""
        x = ((np.arange(width) + 0.5) / width * 2.0 - 1.0) * self.tan_x
        y = (1.0 - (np.arange(height) + 0.5) / height * 2.0) * self.tan_y
        rays: F64 = (
            x[None, :, None] * self.right + y[:, None, None] * self.up - self.back
        ).reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        return rays

    def view_projection(self, near: float, far: float) -> Float64[F64, "4 4"]:
        """Return the matrix from world to clip space (column vectors, OpenGL's depth -1..1)."""
        rotation = np.stack([self.right, self.up, self.back])
        view = np.eye(4)
        view[:3, :3] = rotation
        view[:3, 3] = -rotation @ self.eye
        projection = np.zeros((4, 4))
        projection[0, 0] = 1.0 / self.tan_x
        projection[1, 1] = 1.0 / self.tan_y
        projection[2, 2] = -(far + near) / (far - near)
        projection[2, 3] = -2.0 * far * near / (far - near)
        projection[3, 2] = -1.0
        return projection @ view

    def moved(self, offset: Float64[F64, " xyz"], scale: float) -> "Pinhole":
        """Return the same view in coordinates (p - offset) * scale."""
        eye = (self.eye - offset) * scale
        return Pinhole(eye, self.right, self.up, self.back, self.tan_x, self.tan_y)


def pinhole(camera: Camera, width: int, height: int, bounds: Float64[F64, "2 3"]) -> Pinhole:
    """Decide eye and target where a camera leaves them open.

    Parameters
    ----------
    camera
        ``fov_deg`` is vertical; azimuth 0 looks from +z, 90 from +x; an open target is the middle
        of the bounds, an open eye stands where the bounds fill the picture.
    width, height
        Pixels; only their ratio matters here.
    bounds
        Lower and upper corner of what is to be seen.

    Raises
    ------
    SettingsError
        Eye and target coincide, or the view runs along ``up``.
    """
    tan_y = float(np.tan(np.radians(camera.fov_deg) / 2.0))
    tan_x = tan_y * width / height
    target = bounds.mean(axis=0) if camera.target is None else np.asarray(camera.target, float)
    if camera.eye is None:
        azimuth, elevation = np.radians([camera.azimuth_deg, camera.elevation_deg])
        back = np.array(
            [
                np.sin(azimuth) * np.cos(elevation),
                np.sin(elevation),
                np.cos(azimuth) * np.cos(elevation),
            ]
        )
    else:
        back = np.asarray(camera.eye, float) - target
    length = float(np.linalg.norm(back))
    if length == 0.0:
        raise SettingsError(f"camera {camera.name!r}: eye and target coincide")
    back = back / length
    right = np.cross(np.asarray(camera.up, float), back)
    sine = float(np.linalg.norm(right)) / max(float(np.linalg.norm(camera.up)), 1e-300)
    if sine < PARALLEL:
        raise SettingsError(f"camera {camera.name!r}: it looks along its own up vector")
    right = right / np.linalg.norm(right)
    up = np.cross(back, right)
    if camera.eye is None:
        eye = target + _distance(bounds - target, right, up, back, tan_x, tan_y) * back
    else:
        eye = np.asarray(camera.eye, float)
    return Pinhole(eye, right, up, back, tan_x, tan_y)


def camera_rays(
    camera: Camera, width: int, height: int, bounds: Float64[F64, "2 3"]
) -> tuple[Float64[F64, "rays 3"], Float64[F64, "rays 3"]]:
    """Return origins and unit directions through the pixel centres, from the upper left."""
    view = pinhole(camera, width, height, bounds)
    directions = view.directions(width, height)
    return np.tile(view.eye, (len(directions), 1)), directions


def framing_bounds(
    positions: Float64[F64, "verts 3"], vertex_ranges: Sequence[tuple[int, int]]
) -> Float64[F64, "2 3"]:
    """Return the bounds that automatic framing fills the picture with: those of some parts.

    Of the object, that is, not of the receiver under it.
    """
    own = np.concatenate([positions[start:stop] for start, stop in vertex_ranges])
    return np.stack([own.min(axis=0), own.max(axis=0)])


def depth_range(view: Pinhole, bounds: Float64[F64, "2 3"]) -> tuple[float, float]:
    """Near and far distances along the view that hold the bounds, at most 1 to 10,000 apart."""
    depths = (view.eye - _corners(bounds)) @ view.back
    diagonal = float(np.linalg.norm(bounds[1] - bounds[0]))
    far = max(float(depths.max()), 0.0) + 0.01 * diagonal
    near = max(float(depths.min()) - 0.01 * diagonal, 1e-4 * far)
    return near, far


def _distance(bounds: F64, right: F64, up: F64, back: F64, tan_x: float, tan_y: float) -> float:
    """Smallest distance from the target at which all corners of the bounds are in the picture."""
    corners = _corners(bounds)
    depth = corners @ back
    side = np.abs(corners @ right) / tan_x
    height = np.abs(corners @ up) / tan_y
    return float((depth + MARGIN * np.maximum(side, height)).max())


def _corners(bounds: F64) -> F64:
    pick = np.array([[i >> k & 1 for k in range(3)] for i in range(8)])
    return np.asarray(bounds[pick, np.arange(3)])
