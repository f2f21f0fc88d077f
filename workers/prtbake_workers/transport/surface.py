"""The surface where rays hit it: interpolated points, and which side of a triangle faces a ray."""

import numpy as np

from prtbake_workers.arrays import B8, F32, F64, I64, Bool, Float32, Float64, Int64
from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.reference import SurfacePoints

HORIZON = 1e-3
"""Cosine that a view direction is lifted to where a smooth normal leans away from the eye, as the
decoder does: a silhouette is then as bright as its neighbourhood."""


def interpolate_surface(
    scene: Scene, triangles: Int64[I64, " points"], barycentrics: Float64[F64, "points 3"]
) -> SurfacePoints:
    """Give the points of triangles, with their smooth normals and the side that these shade."""
    corners = scene.faces[triangles]
    weights = barycentrics[:, :, None]
    positions = (scene.positions[corners] * weights).sum(axis=1)
    normals = (scene.normals[corners] * weights).sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    edges = scene.positions[corners[:, 1:]] - scene.positions[corners[:, :1]]
    side = np.cross(edges[:, 0], edges[:, 1])
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
    side *= np.where((side * normals).sum(axis=1) < 0.0, -1.0, 1.0)[:, None]
    return SurfacePoints(positions, normals, side)


def above_horizon(
    wo: Float64[F64, "points 3"], normals: Float64[F64, "points 3"]
) -> Float64[F64, "points 3"]:
    """Lift directions whose cosine is below `HORIZON` to it."""
    lift = np.maximum(HORIZON - (wo * normals).sum(axis=1, keepdims=True), 0.0)
    lifted = wo + lift * normals
    return np.asarray(lifted / np.linalg.norm(lifted, axis=1, keepdims=True))


class FaceSides:
    """Tells rays that meet the front of a triangle from those that meet its back.

    The front is the side that the interpolated normals stand on, whatever the winding: the same
    rule as `interpolate_surface`, from two small tables a triangle.
    """

    def __init__(self, scene: Scene) -> None:
        across = face_area_vectors(scene.positions, scene.faces)
        leaning = np.einsum("tj,tcj->tc", across, scene.normals[scene.faces])
        # only signs are read: lengths would underflow in float32 on a tiny scene
        length = np.linalg.norm(across, axis=1, keepdims=True)
        length = np.where(length > 0.0, length, 1.0)
        self._across: F32 = (across / length).astype(np.float32)
        self._leaning: F64 = leaning / length

    def front(
        self,
        triangles: Int64[I64, " hits"],
        barycentrics: Float64[F64, "hits 3"],
        directions: Float32[F32, "hits 3"],
    ) -> Bool[B8, " hits"]:
        """Whether each ray comes from the front of the triangle that it hits."""
        approach = np.einsum("hj,hj->h", self._across[triangles], directions)
        leaning = np.einsum("hc,hc->h", self._leaning[triangles], barycentrics)
        return np.asarray(np.where(leaning < 0.0, approach > 0.0, approach < 0.0))
