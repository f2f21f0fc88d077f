"""Pictures as files."""

import io
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from prtbake_storage.errors import InputError
from prtbake_workers.render.images import (
    auto_exposure,
    difference_image,
    exr_bytes,
    heat,
    png_bytes,
    read_albedo_texture,
    side_by_side,
    to_srgb8,
)


def picture(rng: np.random.Generator, height: int = 6, width: int = 8) -> np.ndarray:
    return rng.random((height, width, 3)).astype(np.float32)


def decode(data: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(data)))


def test_png_holds_the_pixels(rng: np.random.Generator) -> None:
    pixels = to_srgb8(picture(rng), 1.0)
    data = png_bytes(pixels)
    np.testing.assert_array_equal(decode(data), pixels)
    assert data == png_bytes(pixels)


def test_alpha_is_straight_in_the_file() -> None:
    radiance = np.full((1, 3, 3), 0.5, np.float32) * np.array([0.0, 0.5, 1.0])[None, :, None]
    coverage = np.array([[0.0, 0.5, 1.0]], np.float32)
    found = decode(png_bytes(to_srgb8(radiance.astype(np.float32), 1.0), coverage))
    assert found[0, :, 3].tolist() == [0, 128, 255]
    # half-covered grey is the same grey, half opaque; 8-bit codes leave one step
    assert abs(int(found[0, 1, 0]) - int(found[0, 2, 0])) <= 1
    assert found[0, 2, 0] == 188


def test_exr_is_exact(rng: np.random.Generator, tmp_path: Path) -> None:
    radiance = picture(rng) * 1e4 - 3.0
    coverage = rng.random((6, 8)).astype(np.float32)
    for given in (None, coverage):
        path = tmp_path / "x.exr"
        path.write_bytes(exr_bytes(radiance, given, scratch=tmp_path))
        assert list(tmp_path.iterdir()) == [path]
        with OpenEXR.File(str(path)) as file:
            name = "RGB" if given is None else "RGBA"
            found = np.asarray(file.channels()[name].pixels)
        np.testing.assert_array_equal(found[:, :, :3], radiance)
        if given is not None:
            np.testing.assert_array_equal(found[:, :, 3], coverage)


def test_exposure_looks_at_covered_pixels_only(rng: np.random.Generator) -> None:
    radiance = np.full((10, 10, 3), 4.0, np.float32)
    coverage = np.ones((10, 10), np.float32)
    assert auto_exposure(radiance, coverage) == pytest.approx(0.2)
    radiance[0] = 1e6
    coverage[0] = 0.0
    assert auto_exposure(radiance, coverage) == pytest.approx(0.2)
    assert auto_exposure(radiance, np.zeros_like(coverage)) == 1.0
    assert auto_exposure(np.zeros_like(radiance), coverage) == 1.0
    spot = np.zeros((10, 10, 3), np.float32)
    spot[5, 5] = 2.0
    assert auto_exposure(spot, coverage) == pytest.approx(0.4)


def test_textures_are_decoded_to_linear_light() -> None:
    grey = np.full((2, 3, 3), 188, np.uint8)
    found = read_albedo_texture(png_bytes(grey))
    assert found.shape == (2, 3, 3)
    # code 188 is half the light, to half a code
    assert found[0, 0, 0] == pytest.approx(0.5, abs=3e-3)
    for bad in (b"", b"not a picture", png_bytes(grey)[:40]):
        with pytest.raises(InputError, match="no picture"):
            read_albedo_texture(bad)


def test_every_code_of_a_texture_is_decoded_as_the_formula_says() -> None:
    codes = np.arange(256 * 3, dtype=np.uint16).reshape(16, 16, 3).astype(np.uint8)
    expected = [
        c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in codes.ravel() / 255.0
    ]
    found = read_albedo_texture(png_bytes(codes))
    assert found.dtype == np.float32
    # float32
    np.testing.assert_allclose(found.ravel(), expected, rtol=1e-7)


def png_header(width: int, height: int) -> bytes:
    """A PNG that says how large it is, and holds nothing."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk))
    return b"\x89PNG\r\n\x1a\n" + body + struct.pack(">I", 0) + b"IDAT"


# ours; what the picture library warns of; what it refuses itself
@pytest.mark.parametrize("size", [(8192, 8193), (10_000, 10_000), (16_384, 16_384)])
def test_textures_of_too_many_pixels_are_refused_before_they_are_decoded(
    size: tuple[int, int],
) -> None:
    with pytest.raises(InputError, match=r"pixels: at most 67108864 are taken"):
        read_albedo_texture(png_header(*size))
    # the negative twin: one of the largest size gets as far as the pixels that are not there
    with pytest.raises(InputError, match="no picture"):
        read_albedo_texture(png_header(8192, 8192))


def test_decoding_a_texture_takes_little_more_than_its_result() -> None:
    side = 512
    data = png_bytes(np.full((side, side, 3), 188, np.uint8))
    tracemalloc.start()
    read_albedo_texture(data)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # 12 bytes a pixel are the result, 3 to 6 its codes; through float64 it took 106
    assert peak < 24 * side**2


def test_differences_are_heat(rng: np.random.Generator) -> None:
    reference = picture(rng)
    test = reference.copy()
    test[2, 3] += 1.0
    shown = difference_image(test, reference, full_scale=3.0**0.5)
    assert shown[2, 3].tolist() == [255, 255, 255]
    assert not np.delete(shown.reshape(-1, 3), 2 * 8 + 3, axis=0).any()
    ramp = heat(np.linspace(0, 1, 100, dtype=np.float32)[None]).astype(int).sum(axis=2)[0]
    assert (np.diff(ramp) > 0).all()
    row = side_by_side([shown, shown, shown])
    assert row.shape == (6, 3 * 8 + 2 * 8, 3)
