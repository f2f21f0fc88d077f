"""Job kind ``render``: previews and turntables from an asset and a light."""

from collections.abc import Callable
from typing import Any

from prtbake_storage.contract.settings import RenderSettings
from prtbake_storage.decode.relight import rotation_matrix, whitened_light
from prtbake_storage.decode.srbf import whitening
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.resources import read_light
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.render.images import auto_exposure, exr_bytes, png_bytes, tone_map
from prtbake_workers.render.renderer import open_renderer

_MODULE = "prtbake_workers.jobs.render"


def stages(inputs_of: Callable[[Results], dict[str, Any]], settings: RenderSettings) -> list[Stage]:
    """Render in one task; ``inputs_of`` gives the digests of asset and light."""
    dumped = settings.model_dump(mode="json")

    def render(results: Results) -> list[Task]:
        return [Task(f"{_MODULE}:render", {**inputs_of(results), "settings": dumped})]

    return [Stage("render", "pictures", 3.0, render)]


def render(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
    """Task: one PNG and one EXR a camera, then the turntable's PNGs with the light turning."""
    settings = RenderSettings.model_validate(args["settings"])
    asset = read_asset(context.store.local_path(args["asset"]))
    light = read_light(context.store.local_path(args["light"]))
    roots = whitening(asset.centres, asset.bandwidth)
    base = rotation_matrix(settings.rotation_deg)
    frames = settings.turntable_frames
    total = len(settings.cameras) + frames
    pictures = []
    with open_renderer(
        asset, settings.width, settings.height, backend=settings.backend
    ) as renderer:
        renderer.set_light(whitened_light(asset, light, base, roots=roots))
        exposure = settings.exposure
        for camera in settings.cameras:
            image = renderer.render(camera)
            exposure = exposure or auto_exposure(image)
            pictures.append(
                {
                    "name": f"preview-{camera.name}.png",
                    "media_type": "image/png",
                    "digest": context.store.put_bytes(png_bytes(tone_map(image, exposure))),
                }
            )
            pictures.append(
                {
                    "name": f"preview-{camera.name}.exr",
                    "media_type": "image/x-exr",
                    "digest": context.store.put_bytes(exr_bytes(image, context.scratch)),
                }
            )
            context.progress(len(pictures) / 2, total, "pictures")
        for frame in range(frames):
            turn = rotation_matrix((0.0, 360.0 * frame / frames, 0.0))
            renderer.set_light(whitened_light(asset, light, turn @ base, roots=roots))
            image = renderer.render(settings.cameras[0])
            pictures.append(
                {
                    "name": f"turntable-{frame:03d}.png",
                    "media_type": "image/png",
                    "digest": context.store.put_bytes(
                        png_bytes(tone_map(image, exposure or auto_exposure(image)))
                    ),
                }
            )
            context.progress(len(settings.cameras) + frame + 1, total, "pictures")
        info = renderer.info.to_dict()
    return {"pictures": pictures, "renderer": info, "exposure": exposure}
