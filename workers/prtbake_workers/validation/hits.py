"""Where a camera's pixel centres meet the scene: the points that all pictures of a chain share."""

from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.settings import Camera
from prtbake_workers.arrays import B8, F32, F64, I64, Bool, Float32, Float64, Int64
from prtbake_workers.brdf.base import is_isotropic
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.render.camera import camera_rays, framing_bounds
from prtbake_workers.transport.path_points import interpolated_frames
from prtbake_workers.transport.reference import SurfacePoints
from prtbake_workers.transport.surface import above_horizon, interpolate_surface, turn_to_front
from prtbake_workers.validation.scene import ValidationScene


@dataclass(frozen=True)
class PixelHits:
    """The pixels of one camera that show a front face, and the vertices behind them.

    ``frames`` are those that true BRDFs are read in: where they are anisotropic, the corners' own,
    their tangents interpolated and laid into the tangent plane again.
    """

    width: int
    height: int
    pixels: Int64[I64, " hits"]
    triangles: Int64[I64, " hits"]
    barycentrics: Float32[F32, "hits 3"]
    parts: Int64[I64, " hits"]
    points: SurfacePoints
    frames: Float64[F64, "hits 3 3"]
    wo: Float64[F64, "hits 3"]
    vertices: Int64[I64, " verts"]
    """The distinct corners of the triangles seen, in scene numbering."""

    def vertices_of(self, start: int, stop: int) -> Int64[I64, " part_verts"]:
        """Return the vertices seen that lie in start..stop, the range of a part."""
        first, last = np.searchsorted(self.vertices, [start, stop])
        return self.vertices[first:last]

    @property
    def coverage(self) -> Bool[B8, "height width"]:
        """The pixels that show the scene."""
        covered = np.zeros(self.height * self.width, np.bool_)
        covered[self.pixels] = True
        return covered.reshape(self.height, self.width)

    def picture(self, colours: Float64[F64, "hits 3"]) -> Float32[F32, "height width 3"]:
        """Lay the colours of the hits out as a picture; everything else is black."""
        image = np.zeros((self.height * self.width, 3), np.float32)
        image[self.pixels] = colours
        return image.reshape(self.height, self.width, 3)


def trace_camera(validation: ValidationScene, camera: Camera, width: int, height: int) -> PixelHits:
    """Trace one ray through every pixel centre and keep the hits that face the eye."""
    scene = validation.scene
    object_bounds = framing_bounds(scene.positions, validation.delivered.object_ranges)
    origins, directions = camera_rays(camera, width, height, object_bounds)
    hits = validation.accelerator.intersect(
        np.asarray(origins, np.float32), np.asarray(directions, np.float32)
    )
    pixels = np.flatnonzero(hits.triangles >= 0)
    triangles = hits.triangles[pixels].astype(np.int64)
    if scene.traced is not None:
        triangles = scene.traced[triangles]
    barycentrics = hits.barycentrics[pixels]
    wo = -np.asarray(directions, np.float64)[pixels]
    points = interpolate_surface(scene, triangles, barycentrics.astype(np.float64))
    front = (wo * points.side).sum(axis=1) > 0.0
    if scene.opposite is not None:
        turn_to_front(scene, triangles, barycentrics, front)
        points = interpolate_surface(scene, triangles, barycentrics.astype(np.float64))
    keep = np.flatnonzero(front)
    corners = scene.faces[triangles]
    wo = above_horizon(wo, points.normals)
    parts = validation.part_of_triangle(triangles)
    frames = tangent_frames(points.normals)
    for index, part in enumerate(validation.parts):
        if not is_isotropic(part.brdf):
            own = np.flatnonzero(parts == index)
            frames[own] = interpolated_frames(
                scene, triangles[own], barycentrics[own].astype(np.float64), points.normals[own]
            )
    return PixelHits(
        width=width,
        height=height,
        pixels=pixels[keep],
        triangles=triangles[keep],
        barycentrics=barycentrics[keep],
        parts=parts[keep],
        points=points.block(keep),
        frames=frames[keep],
        wo=wo[keep],
        vertices=np.unique(corners[keep]).astype(np.int64),
    )
