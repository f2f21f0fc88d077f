"""What the cameras of a validation show: pixels and vertices, which is what its pictures cost."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.settings import Camera
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.render.camera import camera_rays, framing_bounds

MOST_RAYS = 1 << 16
"""Of a camera: a larger picture is looked at through every second or third pixel."""


@dataclass(frozen=True)
class SeenPixels:
    """What one camera shows.

    Attributes
    ----------
    pixels
        That show the scene.
    vertices
        Corners of the triangles behind them.
    inside
        Pixels of these that show a part which scatters light inside.
    parts
        Pixels that show each part.
    """

    pixels: int
    vertices: int
    inside: int
    parts: Sequence[int]


def look(
    scene: Scene,
    accelerator: Accelerator,
    cameras: Sequence[Camera],
    *,
    width: int,
    height: int,
    object_ranges: Sequence[tuple[int, int]],
    media: Collection[int] = (),
) -> tuple[SeenPixels, ...]:
    """Trace one ray a pixel of every camera.

    ``accelerator`` holds all that is traced of the scene, ``media`` are the parts that have one.
    Backs of surfaces count as seen, which validation leaves black: few cameras look inside.
    """
    bounds = framing_bounds(scene.positions, object_ranges)
    return tuple(
        _seen(scene, accelerator, camera, width, height, bounds, media) for camera in cameras
    )


def _seen(
    scene: Scene,
    accelerator: Accelerator,
    camera: Camera,
    width: int,
    height: int,
    bounds: Float64[F64, "2 3"],
    media: Collection[int],
) -> SeenPixels:
    step = 1
    while (width // step) * (height // step) > MOST_RAYS:
        step += 1
    columns, rows = max(1, width // step), max(1, height // step)
    origins, directions = camera_rays(camera, columns, rows, bounds)
    hits = accelerator.intersect(
        np.asarray(origins, np.float32), np.asarray(directions, np.float32)
    )
    triangles = hits.triangles[hits.triangles >= 0].astype(np.int64)
    if scene.traced is not None:
        triangles = scene.traced[triangles]
    scale = width * height / (columns * rows)
    shown = np.bincount(scene.part_of_face[triangles], minlength=len(scene.part_ranges))
    parts = tuple(round(scale * int(count)) for count in shown)
    return SeenPixels(
        pixels=sum(parts),
        vertices=len(np.unique(scene.faces[triangles])),
        inside=sum(parts[part] for part in media),
        parts=parts,
    )
