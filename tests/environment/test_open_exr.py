"""OpenEXR pictures: channels, windows, what is refused."""

import numpy as np
import OpenEXR
import pytest

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.environment.open_exr import decode_open_exr


def planes(picture, dtype=np.float32):
    return {c: np.ascontiguousarray(picture[:, :, i].astype(dtype)) for i, c in enumerate("RGB")}


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_half_and_float_come_back_exactly(make_exr, smooth_picture, dtype) -> None:
    picture = decode_open_exr(make_exr(planes(smooth_picture, dtype)))
    assert np.array_equal(picture.pixels, smooth_picture)
    assert picture.pixel_type == np.dtype(dtype).name
    assert picture.layout_attribute is None


def test_one_channel_is_grey(make_exr, smooth_picture) -> None:
    picture = decode_open_exr(make_exr({"Y": np.ascontiguousarray(smooth_picture[:, :, 1])}))
    assert np.array_equal(picture.pixels, np.repeat(smooth_picture[:, :, 1:2], 3, axis=2))
    assert "grey" in picture.warnings[0]


def test_alpha_is_left_unused_and_named(make_exr, smooth_picture) -> None:
    channels = {**planes(smooth_picture), "A": np.ones((32, 64), np.float32)}
    picture = decode_open_exr(make_exr(channels))
    assert np.array_equal(picture.pixels, smooth_picture)
    assert picture.warnings == ("channels left unused: A",)


@pytest.mark.parametrize(
    ("attribute", "layout"),
    [(OpenEXR.ENVMAP_LATLONG, "lat_long_exr"), (OpenEXR.ENVMAP_CUBE, "cube_strip")],
)
def test_envmap_attribute_names_the_layout(make_exr, smooth_picture, attribute, layout) -> None:
    data = make_exr(planes(smooth_picture), envmap=attribute)
    assert decode_open_exr(data).layout_attribute == layout


def test_data_window_is_placed_in_the_display_window(make_exr, smooth_picture) -> None:
    def window(x0, y0, x1, y1):
        return (np.array([x0, y0], np.int32), np.array([x1, y1], np.int32))

    # 4 columns stick out on the left, 8 rows at the bottom are without data
    data = make_exr(
        planes(smooth_picture), dataWindow=window(-4, 0, 59, 31), displayWindow=window(0, 0, 79, 39)
    )
    picture = decode_open_exr(data)
    assert picture.pixels.shape == (40, 80, 3)
    assert np.array_equal(picture.pixels[:32, :60], smooth_picture[:, 4:])
    assert (picture.pixels[32:] == 0).all()
    assert (picture.pixels[:, 60:] == 0).all()
    assert f"{40 * 80 - 32 * 60} pixels" in picture.warnings[0]


def test_other_primaries_are_named(make_exr, smooth_picture) -> None:
    wide = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
    picture = decode_open_exr(make_exr(planes(smooth_picture), chromaticities=wide))
    assert "chromaticities" in picture.warnings[0]


def test_channels_that_are_no_colour_are_named(make_exr, smooth_picture) -> None:
    plane = np.ascontiguousarray(smooth_picture[:, :, 0])
    with pytest.raises(EnvironmentMapError, match=r"R, Z"):
        decode_open_exr(make_exr({"R": plane, "Z": plane}))


@pytest.mark.parametrize("keep", [4, 100, 2000, -3000, -3])
def test_a_file_that_ends_early_is_refused(make_exr, smooth_picture, keep) -> None:
    noise = np.random.default_rng(1).random(smooth_picture.shape).astype(np.float32)
    data = make_exr(planes(noise))
    assert len(data) > 2000
    with pytest.raises(EnvironmentMapError, match="cannot be read"):
        decode_open_exr(data[:keep])
