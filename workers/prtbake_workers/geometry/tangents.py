"""Tangents that lie as the grain of a material does: along u, along a direction, or horizontally.

A BRDF that depends on the tangent is mirror-symmetric about x and about y, so a tangent and its
opposite are the same to it: what counts is a line in the tangent plane, and what runs the other way
on a mirrored chart changes nothing.
"""

from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.materials import Tangents
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import B8, F64, I32, I64, Bool, Float64, Int32, Int64
from prtbake_workers.geometry.frames import POLE_SINE, tangent_frames
from prtbake_workers.geometry.mesh import Mesh, face_area_vectors

DIRECTION_SINE = 1e-6
"""Sine of the angle between normal and direction below which the direction tells nothing: ten times
the rounding of normals that a file holds in float32."""

CANCELLED = 1e-6
"""Length of the mean of all lines about a vertex, at most 1, below which they cancel."""

FLAT_UV = 1e-9
"""Sine between two edges in texture coordinates below which a triangle has no usable ones."""


@dataclass(frozen=True, eq=False)
class OrientedFrames:
    """Frames of a mesh, and the vertices where nothing tells their direction.

    Attributes
    ----------
    frames
        Rows tangent, bitangent, normal; right-handed, as those of `tangent_frames`.
    singular
        Vertices that have the horizontal tangent in place of what was asked for, rising.
    """

    frames: Float64[F64, "verts 3 3"]
    singular: Int64[I64, " singular"]


def oriented_frames(mesh: Mesh, tangents: Tangents) -> OrientedFrames:
    """Complete the normals of a mesh to frames whose tangents point as asked.

    Parameters
    ----------
    mesh
        Vertices that differ in texture coordinates alone (seams) have frames of their own.
    tangents
        ``uv``: along dP/du, see `texture_lines`.  Three numbers: along that direction, projected
        into the tangent plane.  ``horizontal``: see `tangent_frames`.

    Raises
    ------
    SettingsError
        ``uv`` without texture coordinates, or a direction without a length.

    Notes
    -----
    Singular are vertices in none but degenerate texture triangles, or where the triangles' lines
    cancel; normals along the direction; and, for horizontal tangents, along y.
    """
    frames = tangent_frames(mesh.normals)
    if tangents == "horizontal":
        level = np.hypot(mesh.normals[:, 0], mesh.normals[:, 2]) <= POLE_SINE
        return OrientedFrames(frames, np.flatnonzero(level))
    if tangents == "uv":
        if mesh.uv is None:
            raise SettingsError("tangents along u need texture coordinates, which the mesh lacks")
        cosine, sine, usable = texture_lines(mesh.positions, mesh.faces, mesh.uv, frames)
    else:
        direction = np.asarray(tangents, np.float64)
        length = float(np.linalg.norm(direction))
        if not (np.isfinite(length) and length > 0.0):
            raise SettingsError(f"tangents along {list(tangents)}: a direction needs a length")
        x, y = np.moveaxis(frames[:, :2] @ (direction / length), 1, 0)
        size = np.hypot(x, y)
        usable = size > DIRECTION_SINE
        divisor = np.where(usable, size, 1.0)
        cosine, sine = np.where(usable, x / divisor, 1.0), np.where(usable, y / divisor, 0.0)
    return OrientedFrames(_turned(frames, cosine, sine), np.flatnonzero(~usable))


def texture_lines(
    positions: Float64[F64, "verts 3"],
    faces: Int32[I32, "tris 3"],
    uv: Float64[F64, "verts 2"],
    frames: Float64[F64, "verts 3 3"],
) -> tuple[Float64[F64, " verts"], Float64[F64, " verts"], Bool[B8, " verts"]]:
    """Average the lines along dP/du of the triangles around each vertex, weighted by area.

    Each triangle's dP/du is projected into the vertex's tangent plane; its angle is doubled, which
    maps opposite directions to one, averaged and halved.  The sense is that of most of the area.

    Returns
    -------
    cosine, sine
        Of the angle to the frames' tangents; 1 and 0 where there is no line.
    usable
        False in none but degenerate texture triangles and where lines cancel.
    """
    along, area = _texture_directions(positions, faces, uv)
    corners = faces.ravel()
    at = frames[corners, :2] @ np.repeat(along, 3, axis=0)[:, :, None]
    planar = at[:, 0, 0] + 1j * at[:, 1, 0]
    size = np.abs(planar)
    unit = np.where(size > CANCELLED, planar / np.where(size > CANCELLED, size, 1.0), 0.0)
    weight = np.repeat(area, 3) * (size > CANCELLED)
    total = np.bincount(corners, weight, len(positions))
    doubled, single = (
        _summed(corners, weight * turned, len(positions)) for turned in (unit**2, unit)
    )
    usable = np.abs(doubled) > CANCELLED * np.where(total > 0.0, total, 1.0)
    angle = np.where(usable, 0.5 * np.angle(doubled), 0.0)
    cosine, sine = np.cos(angle), np.sin(angle)
    backwards = cosine * single.real + sine * single.imag < 0.0
    sense = np.where(usable & backwards, -1.0, 1.0)
    return sense * cosine, sense * sine, usable


def _texture_directions(
    positions: Float64[F64, "verts 3"], faces: Int32[I32, "tris 3"], uv: Float64[F64, "verts 2"]
) -> tuple[Float64[F64, "tris 3"], Float64[F64, " tris"]]:
    """Give each triangle's unit dP/du and area; both 0 where its texture triangle is degenerate."""
    corner, texel = positions[faces], uv[faces]
    first, second = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    (du_1, dv_1), (du_2, dv_2) = (texel[:, k].T - texel[:, 0].T for k in (1, 2))
    determinant = du_1 * dv_2 - du_2 * dv_1
    # a mirrored chart has a negative determinant, and u runs where it runs
    along = (first * dv_2[:, None] - second * dv_1[:, None]) * np.sign(determinant)[:, None]
    length = np.linalg.norm(along, axis=1)
    scale = np.hypot(du_1, dv_1) * np.hypot(du_2, dv_2)
    usable = (np.abs(determinant) > FLAT_UV * scale) & (length > 0.0)
    along = np.where(usable[:, None], along / np.where(usable, length, 1.0)[:, None], 0.0)
    area = np.linalg.norm(face_area_vectors(positions, faces), axis=1)
    return along, np.where(usable, area, 0.0)


def _summed(corners: I32, values: np.ndarray, count: int) -> np.ndarray:
    real = np.bincount(corners, values.real, count)
    return np.asarray(real + 1j * np.bincount(corners, values.imag, count))


def _turned(
    frames: Float64[F64, "verts 3 3"], cosine: Float64[F64, " verts"], sine: Float64[F64, " verts"]
) -> Float64[F64, "verts 3 3"]:
    """Turn frames about their normals."""
    c, s = cosine[:, None], sine[:, None]
    tangents, bitangents = frames[:, 0], frames[:, 1]
    turned = [c * tangents + s * bitangents, c * bitangents - s * tangents, frames[:, 2]]
    return np.stack(turned, axis=1)
