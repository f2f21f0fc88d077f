"""Bounds of pictures' bytes, against pictures that do not pack."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import RenderSettings, ValidateSettings
from prtbake_workers.planning.picture_bytes import (
    exr_at_most,
    png_at_most,
    preview_files,
    validation_files,
    with_reports,
)
from prtbake_workers.render.animation import write_animation
from prtbake_workers.render.images import exr_bytes, png_bytes

SIZES = [(16, 16), (97, 40), (400, 333)]


@pytest.mark.parametrize("size", SIZES)
def test_noise_takes_no_more_and_not_much_less(size, rng, tmp_path):
    width, height = size
    colours = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    radiance = rng.normal(size=(height, width, 3)).astype(np.float32)
    coverage = rng.random((height, width)).astype(np.float32)
    frames = iter([colours, 255 - colours, colours // 2])
    write_animation(tmp_path / "turntable.png", frames, 3, 12.0)
    made = {
        png_at_most(width, height, 3): len(png_bytes(colours)),
        png_at_most(width, height, 4): len(png_bytes(colours, coverage)),
        exr_at_most(width, height): len(exr_bytes(radiance, coverage)),
        png_at_most(width, height, 3, 3): (tmp_path / "turntable.png").stat().st_size,
    }
    for bound, size_of in made.items():
        assert size_of <= bound
        # a bound of the right order: most of noise cannot be packed
        assert bound < 1.6 * size_of + 8000


def test_files_are_named_as_jobs_name_them():
    cameras = [{"name": "front"}, {"name": "top", "elevation_deg": 80.0}]
    previews = preview_files(RenderSettings(cameras=cameras, turntable_frames=5))
    assert set(previews) == {
        "preview-front.png", "preview-front.exr", "preview-top.png", "preview-top.exr",
        "turntable.png",
    }  # fmt: skip
    one = validation_files(ValidateSettings(cameras=cameras))
    assert set(one) == {"validation-front.png", "validation-top.png"}
    rotations = [(0.0, 0.0, 0.0), (0.0, 90.0, 0.0)]
    two = validation_files(ValidateSettings(cameras=cameras, rotations_deg=rotations))
    assert "validation-top-light1.png" in two
    assert len(two) == 4


def test_the_page_holds_the_pictures_that_it_shows():
    bare = with_reports({}, n_parts=1)
    files = with_reports({"preview-front.png": 30_000, "turntable.png": 1 << 20}, n_parts=1)
    assert files["report.html"] - bare["report.html"] >= 40_000
    assert files["report.html"] - bare["report.html"] < 1 << 18
