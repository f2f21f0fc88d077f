"""Job kind ``render``: previews and turntables from an asset and a light."""

from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

import numpy as np

from prtbake_storage.contract.settings import RenderSettings
from prtbake_storage.decode.relight import project_light, rotation_matrix
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.arrays import U8
from prtbake_workers.render.animation import write_animation
from prtbake_workers.render.camera import framing_bounds, pinhole
from prtbake_workers.render.images import (
    auto_exposure,
    exr_bytes,
    png_bytes,
    to_srgb8,
)
from prtbake_workers.render.renderer import open_renderer

_MODULE = "prtbake_workers.jobs.render"
SAMPLES = 2
"""Points a pixel, along each side."""
FRAMES_PER_SECOND = 15.0
MEMORY_BYTES = 24 << 30
"""Of address space, of which graphics drivers map far more than they use."""


def stages(inputs_of: Callable[[Results], dict[str, Any]], settings: RenderSettings) -> list[Stage]:
    """Render in one task; ``inputs_of`` gives the digests of asset and light."""
    dumped = settings.model_dump(mode="json")

    def render(results: Results) -> list[Task]:
        args = {**inputs_of(results), "settings": dumped}
        return [Task(f"{_MODULE}:render", args, memory_bytes=MEMORY_BYTES)]

    return [Stage("render", "pictures", 3.0, render)]


def render(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: one PNG and one EXR a camera, then an animated PNG with the light turning."""
    settings = RenderSettings.model_validate(args["settings"])
    asset = read_asset(context.store.local_path(args["asset"]))
    light = read_light(context.store.local_path(args["light"]))
    base = rotation_matrix(settings.rotation_deg)
    frames = settings.turntable_frames
    total = len(settings.cameras) + frames
    pictures = []
    bounds = framing_bounds(asset.positions.astype(np.float64), asset.object_ranges)
    width, height = settings.width, settings.height
    views = [pinhole(camera, width, height, bounds) for camera in settings.cameras]
    with open_renderer(asset, settings.backend) as renderer:
        renderer.set_light(project_light(asset.basis, light, base))
        exposure = settings.exposure
        for camera, view in zip(settings.cameras, views, strict=True):
            picture = renderer.render(view, width, height, samples=SAMPLES)
            exposure = exposure or auto_exposure(picture.radiance, picture.coverage)
            pixels = to_srgb8(picture.radiance, exposure)
            pictures.append(
                {
                    "name": f"preview-{camera.name}.png",
                    "media_type": "image/png",
                    "digest": context.store.put_bytes(png_bytes(pixels, picture.coverage)),
                }
            )
            pictures.append(
                {
                    "name": f"preview-{camera.name}.exr",
                    "media_type": "image/x-exr",
                    "digest": context.store.put_bytes(
                        exr_bytes(picture.radiance, picture.coverage, scratch=context.scratch)
                    ),
                }
            )
            context.progress(len(pictures) / 2, total, "pictures")

        def turntable() -> Iterator[U8]:
            for frame in range(frames):
                turn = rotation_matrix((0.0, 360.0 * frame / frames, 0.0))
                renderer.set_light(project_light(asset.basis, light, turn @ base))
                picture = renderer.render(views[0], width, height, samples=SAMPLES)
                shown = exposure or auto_exposure(picture.radiance, picture.coverage)
                yield to_srgb8(picture.radiance, shown)
                context.progress(len(settings.cameras) + frame + 1, total, "pictures")

        if frames:
            path = context.scratch / "turntable.png"
            write_animation(path, turntable(), frames, FRAMES_PER_SECOND)
            pictures.append(
                {
                    "name": "turntable.png",
                    "media_type": "image/apng",
                    "digest": context.store.put_file(path, move=True),
                }
            )
        info = asdict(renderer.info)
    return {"pictures": pictures, "renderer": info, "exposure": exposure}
