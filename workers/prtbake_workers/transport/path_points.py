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
"""Length of a mixed tangent below which the corners' frames do not agree on one, as at the poles of
the default frames; any will do there, since only isotropic BRDFs have such frames."""


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
        frames = _frames(scene, triangles, barycentrics, surface.normals)
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


def _frames(
    scene: Scene,
    triangles: Int64[I64, " points"],
    barycentrics: Float64[F64, "points 3"],
    normals: Float64[F64, "points 3"],
) -> Float64[F64, "points 3 3"]:
    """Mix the corners' tangents and complete them to frames about the normals."""
    tangents = np.einsum(
        "pc,pci->pi", barycentrics, scene.frames[scene.faces[triangles], 0], optimize=True
    )
    tangents -= (tangents * normals).sum(axis=1, keepdims=True) * normals
    length = np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents /= np.maximum(length, SHORTEST_TANGENT)
    frames = np.stack([tangents, np.cross(normals, tangents), normals], axis=1)
    lost = length[:, 0] < SHORTEST_TANGENT
    frames[lost] = tangent_frames(normals[lost])
    return frames
