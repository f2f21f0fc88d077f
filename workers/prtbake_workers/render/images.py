"""Pictures as files: exposure, sRGB, PNG and EXR bytes, and pictures beside each other."""

import io
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from prtbake_storage.decode.texture import linear_to_srgb, srgb_to_linear
from prtbake_storage.errors import InputError
from prtbake_workers.arrays import F32, U8, Float32, UInt8
from prtbake_workers.environment.environment import LUMINANCE

EXPOSED_SHARE = 0.98
EXPOSED_TO = 0.8
"""Automatic exposure brings the luminance that 98 % of the covered pixels stay below to 0.8."""

MAX_TEXTURE_PIXELS = 8192 * 8192
"""Largest albedo texture: 0.8 GB in float32 in every task that reads the scene.  Below what the
picture library warns of (89 million), so that every refusal is ours."""

_LINEAR_OF_CODE: F32 = srgb_to_linear(np.arange(256) / 255.0)
GAP = 8


def auto_exposure(
    radiance: Float32[F32, "height width 3"], coverage: Float32[F32, "height width"]
) -> float:
    """Choose the factor for the radiance of what the picture shows; 1 for a black picture."""
    luminance = (radiance.astype(np.float64) @ LUMINANCE)[coverage > 0.5]
    if luminance.size == 0:
        return 1.0
    bright = float(np.quantile(luminance, EXPOSED_SHARE))
    # a light narrower than 2 % of the pixels: then the brightest one has to serve
    bright = bright if bright > 0.0 else float(luminance.max())
    return EXPOSED_TO / bright if bright > 0.0 else 1.0


def to_srgb8(
    radiance: Float32[F32, "height width 3"], exposure: float
) -> UInt8[U8, "height width 3"]:
    """Expose, clip to [0, 1] and encode as 8-bit sRGB."""
    encoded = linear_to_srgb(radiance.astype(np.float64) * exposure)
    pixels: U8 = np.rint(encoded * 255.0).astype(np.uint8)
    return pixels


def png_bytes(
    pixels: UInt8[U8, "height width 3"], coverage: Float32[F32, "height width"] | None = None
) -> bytes:
    """Encode as PNG; ``coverage`` becomes alpha, for colours that were multiplied by it."""
    if coverage is None:
        return _save(Image.fromarray(pixels), "PNG")
    share = np.clip(coverage.astype(np.float64), 0.0, 1.0)
    # PNG's alpha is not pre-multiplied: divide in linear light, where the mixing took place
    linear = srgb_to_linear(pixels / 255.0) / np.maximum(share, 1e-6)[:, :, None]
    straight = np.rint(linear_to_srgb(linear) * 255.0)
    alpha = np.rint(share * 255.0)[:, :, None]
    rgba = np.concatenate([straight, alpha], axis=2).astype(np.uint8)
    return _save(Image.fromarray(rgba), "PNG")


def exr_bytes(
    radiance: Float32[F32, "height width 3"],
    coverage: Float32[F32, "height width"] | None = None,
    *,
    scratch: Path | None = None,
) -> bytes:
    """Encode linear radiance as a float32 OpenEXR file.

    ``scratch`` holds the temporary file that the library insists on.
    """
    if coverage is None:
        channels = {"RGB": np.ascontiguousarray(radiance)}
    else:
        rgba = np.concatenate([radiance, coverage[:, :, None]], axis=2)
        channels = {"RGBA": np.ascontiguousarray(rgba)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        path = Path(folder) / "picture.exr"
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))
        return path.read_bytes()


def read_albedo_texture(data: bytes) -> Float32[F32, "height width 3"]:
    """Decode an 8-bit sRGB picture (PNG, JPEG) to linear Rec.709 in [0, 1].

    Raises
    ------
    InputError
        The bytes are no picture, or one of more than `MAX_TEXTURE_PIXELS`.

    Notes
    -----
    Memory: 12 bytes a pixel for the result, and about as much for the decoder while it works.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            image = Image.open(io.BytesIO(data), formats=("PNG", "JPEG", "BMP", "TGA", "TIFF"))
        with image:
            if image.width * image.height > MAX_TEXTURE_PIXELS:
                raise _too_many_pixels(f"{image.width} x {image.height} pixels")
            pixels = np.asarray(image.convert("RGB"))
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise _too_many_pixels("too many pixels") from error
    except (OSError, SyntaxError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"the albedo texture is no picture: {error}") from error
    linear = np.empty(pixels.shape, np.float32)
    for row, codes in zip(linear, pixels, strict=True):
        # row by row: the index would be copied to 8 bytes a value
        row[:] = _LINEAR_OF_CODE[codes]
    return linear


def _too_many_pixels(what: str) -> InputError:
    return InputError(f"the albedo texture has {what}: at most {MAX_TEXTURE_PIXELS} are taken")


def side_by_side(pictures: Sequence[UInt8[U8, "height width 3"]]) -> UInt8[U8, "height total 3"]:
    """Lay pictures of one height out in a row with a white gap."""
    gap = np.full((pictures[0].shape[0], GAP, 3), 255, np.uint8)
    row = [piece for picture in pictures for piece in (gap, picture)][1:]
    return np.concatenate(row, axis=1)


def difference_image(
    test: Float32[F32, "height width 3"],
    reference: Float32[F32, "height width 3"],
    full_scale: float,
) -> UInt8[U8, "height width 3"]:
    """Show the length of the RGB difference as heat; ``full_scale`` is white."""
    length = np.linalg.norm(test.astype(np.float64) - reference, axis=2)
    return heat((length / full_scale).astype(np.float32))


def heat(values: Float32[F32, "height width"]) -> UInt8[U8, "height width 3"]:
    """Colour values in [0, 1] by a black body: black, red, yellow, white; brightness rises."""
    level = 3.0 * np.clip(values.astype(np.float64), 0.0, 1.0)
    ramps = [np.clip(level - channel, 0.0, 1.0) for channel in range(3)]
    return np.rint(np.stack(ramps, axis=2) * 255.0).astype(np.uint8)


def _save(image: Image.Image, kind: str) -> bytes:
    buffer = io.BytesIO()
    image.save(buffer, kind, compress_level=6)
    return buffer.getvalue()
