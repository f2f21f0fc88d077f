"""Points of a surface with everything that shading them takes."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from prtbake_workers.arrays import B8, F64, I64, Bool, Float64, Int64
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.reference import SurfacePoints
from prtbake_workers.transport.surface import above_horizon, interpolate_surface

SHORTEST_TANGENT = 1e-3
"""Length of a mixed tangent below which the corners' frames do not agree on one, as at their poles:
that of the corner that weighs most serves there."""


@dataclass(frozen=True)
class PathPoints:
    """Points, seen from wo.

    Attributes
    ----------
    surface
        Positions, shading normals, and geometric normals on the same side.
    frames
        Rows tangent, bitangent, shading normal.
    wo
        Unit directions towards the eye, in the world, above the shading horizon.
    triangles, barycentrics
        Where they lie.
    """

    surface: SurfacePoints
    frames: Float64[F64, "points 3 3"]
    wo: Float64[F64, "points 3"]
    triangles: Int64[I64, " points"]
    barycentrics: Float64[F64, "points 3"]

    def __len__(self) -> int:
        return len(self.wo)

    def pick(self, which: I64 | B8) -> "PathPoints":
        """Return some of the points, in the order asked for."""
        surface = self.surface
        return PathPoints(
            SurfacePoints(surface.positions[which], surface.normals[which], surface.side[which]),
            self.frames[which],
            self.wo[which],
            self.triangles[which],
            self.barycentrics[which],
        )

    def replaced(self, which: I64, others: "PathPoints") -> "PathPoints":
        """Put other points in the place of some."""

        def laid(own: F64 | I64, other: F64 | I64) -> Any:
            result = own.copy()
            result[which] = other
            return result

        surface, theirs = self.surface, others.surface
        return PathPoints(
            SurfacePoints(
                laid(surface.positions, theirs.positions),
                laid(surface.normals, theirs.normals),
                laid(surface.side, theirs.side),
            ),
            laid(self.frames, others.frames),
            laid(self.wo, others.wo),
            laid(self.triangles, others.triangles),
            laid(self.barycentrics, others.barycentrics),
        )

    @classmethod
    def seen(
        cls,
        scene: Scene,
        triangles: Int64[I64, " points"],
        barycentrics: Float64[F64, "points 3"],
        wo: Float64[F64, "points 3"],
        two_sided: Bool[B8, " points"],
    ) -> tuple["PathPoints", Bool[B8, " points"]]:
        """Give the points that rays hit, and which of them show a side that reflects.

        A two-sided point that is seen from behind is turned over, about its tangent.
        """
        surface = interpolate_surface(scene, triangles, barycentrics)
        front = (wo * surface.side).sum(axis=1) > 0.0
        frames = interpolated_frames(scene, triangles, barycentrics, surface.normals)
        sign = np.where(front | ~two_sided, 1.0, -1.0)[:, None]
        normals, side = sign * surface.normals, sign * surface.side
        frames[:, 1:] *= sign[:, :, None]
        points = cls(
            SurfacePoints(surface.positions, normals, side),
            frames,
            above_horizon(wo, normals),
            triangles,
            barycentrics,
        )
        return points, front | two_sided

    @classmethod
    def of_vertices(
        cls, scene: Scene, vertices: Int64[I64, " points"], wo: Float64[F64, "points 3"]
    ) -> "PathPoints":
        """Give vertices as the bake sees them: rays start off the vertex along its normal."""
        corner_of = np.zeros(scene.n_vertices, np.int64)
        flat = scene.faces.ravel()
        corner_of[flat[::-1]] = np.arange(flat.size)[::-1]
        triangles, corner = np.divmod(corner_of[vertices], 3)
        normals = scene.normals[vertices]
        return cls(
            SurfacePoints(scene.ray_points[vertices], normals, scene.ray_sides[vertices]),
            scene.frames[vertices],
            above_horizon(wo, normals),
            triangles,
            np.eye(3)[corner],
        )


def interpolated_frames(
    scene: Scene,
    triangles: Int64[I64, " points"],
    barycentrics: Float64[F64, "points 3"],
    normals: Float64[F64, "points 3"],
) -> Float64[F64, "points 3 3"]:
    """Mix the corners' tangents and complete them to frames about the normals.

    A tangent and its opposite are one to every BRDF, so corners are mixed in the sense of the one
    that weighs most.
    """
    corners = scene.frames[scene.faces[triangles], 0]
    first = np.take_along_axis(corners, barycentrics.argmax(axis=1)[:, None, None], axis=1)
    sense = np.where((corners * first).sum(axis=2) < 0.0, -1.0, 1.0)
    mixed = np.einsum("pc,pci->pi", barycentrics * sense, corners, optimize=True)
    tangents, length = _perpendicular(mixed, normals)
    lost = length < SHORTEST_TANGENT
    tangents[lost], length[lost] = _perpendicular(first[lost, 0], normals[lost])
    frames = np.stack([tangents, np.cross(normals, tangents), normals], axis=1)
    nowhere = length < SHORTEST_TANGENT
    frames[nowhere] = tangent_frames(normals[nowhere])
    return frames


def _perpendicular(
    tangents: Float64[F64, "points 3"], normals: Float64[F64, "points 3"]
) -> tuple[Float64[F64, "points 3"], Float64[F64, " points"]]:
    """Project into the tangent planes; also the lengths, before they are brought to one."""
    across = tangents - (tangents * normals).sum(axis=1, keepdims=True) * normals
    length = np.linalg.norm(across, axis=1)
    return across / np.maximum(length, SHORTEST_TANGENT)[:, None], length
