"""Rendering and validation in children of their own, within the memory that they are allowed."""

import io

import numpy as np
import pytest
from PIL import Image

from prtbake_storage.contract.settings import RenderSettings
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs import render
from prtbake_workers.jobs.registry import REGISTRY
from support.task_child import run_child


@pytest.mark.parametrize("backend", ["auto", "cpu"])
def test_a_turntable_is_rendered_frame_by_frame(glossy_asset, store, backend):
    """With a graphics driver's address space too, where there is one."""
    *_, results = glossy_asset
    inputs = {
        "asset": results["quantise"][0]["asset"],
        "light": results["fit_light"][0]["light"],
    }
    settings = RenderSettings(width=32, height=24, turntable_frames=4, backend=backend)
    (task,) = render.stages(lambda _: inputs, settings)[0].tasks(Results())
    assert task.memory_bytes == render.MEMORY_BYTES
    pictures = {picture["name"]: picture for picture in run_child(task, store).result["pictures"]}
    assert pictures["turntable.png"]["media_type"] == "image/apng"
    shown = []
    with Image.open(io.BytesIO(store.read_bytes(pictures["turntable.png"]["digest"]))) as image:
        assert (image.n_frames, image.size) == (4, (32, 24))
        for index in range(4):
            image.seek(index)
            shown.append(np.asarray(image.convert("RGB")).astype(int))
    # the first light is the preview's; then it turns
    preview = Image.open(io.BytesIO(store.read_bytes(pictures["preview-front.png"]["digest"])))
    opaque = np.asarray(preview)[:, :, 3] == 255
    assert opaque.mean() > 0.1
    assert np.abs(shown[0] - np.asarray(preview)[:, :, :3])[opaque].max() <= 1
    assert all(np.abs(one - shown[0]).max() > 8 for one in shown[1:])


def test_a_camera_is_validated_within_its_limit(glossy_asset, store):
    request, context, results = glossy_asset
    (stage,) = (s for s in REGISTRY.stages("asset", request, context) if s.name == "validate")
    tasks = stage.tasks(results)
    assert all(task.memory_bytes for task in tasks)
    again = run_child(tasks[0], store).result
    assert again["views"][0]["hits"] == results["validate"][0]["views"][0]["hits"] > 0
