"""Pictures made in memory."""

import io
from collections.abc import Callable

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray


def rgbe_codes(pixels: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Encode pixels as shared-exponent codes: mantissas in 1/256 of 2^(e - 128)."""
    largest = pixels.max(axis=-1)
    exponent = np.where(largest > 0, np.floor(np.log2(np.maximum(largest, 1e-38))) + 1, -128)
    mantissa = np.floor(pixels / 2.0 ** exponent[..., None] * 256)
    return np.concatenate([mantissa, exponent[..., None] + 128], axis=-1).astype(np.uint8)


@pytest.fixture
def make_hdr() -> Callable[..., bytes]:
    """A flat Radiance file of a picture (rows from the top)."""

    def make(pixels: NDArray[np.float32], header: bytes = b"", resolution: bytes = b"") -> bytes:
        height, width = pixels.shape[:2]
        resolution = resolution or b"-Y %d +X %d" % (height, width)
        start = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n" + header + b"\n" + resolution + b"\n"
        return start + rgbe_codes(pixels).tobytes()

    return make


@pytest.fixture
def make_exr() -> Callable[..., bytes]:
    """An OpenEXR file with the given header attributes and channels."""

    def make(channels: dict[str, NDArray], **header: object) -> bytes:
        data = io.BytesIO()
        defaults = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File({**defaults, **header}, channels).write(data)
        return data.getvalue()

    return make


@pytest.fixture
def smooth_picture() -> NDArray[np.float32]:
    """A 64 x 32 picture, brighter to the right and the top, whose values RGBE holds exactly."""
    rows, columns = np.mgrid[0:32, 0:64]
    return np.stack([128 + columns, 192 - rows, 160 + columns // 4], axis=2).astype(np.float32)
