"""Radiance pictures (.hdr, .pic): RGBE pixels, flat or run-length encoded."""

import math
import re
from dataclasses import dataclass

import cv2
import numpy as np

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.arrays import F32
from prtbake_workers.environment.picture import Picture, check_size

_MAX_HEADER = 1 << 16
_RESOLUTION = re.compile(rb"([-+])([XY]) +(\d{1,9}) +([-+])([XY]) +(\d{1,9})\s*$")


@dataclass(frozen=True)
class _Header:
    """What precedes the pixels: ``major`` scanlines of ``minor`` pixels each."""

    major_axis: str
    major_sign: str
    minor_sign: str
    major: int
    minor: int
    body: int
    scale: tuple[float, float, float]
    warnings: tuple[str, ...]


def is_radiance_hdr(data: bytes) -> bool:
    """Tell whether the bytes begin like a Radiance picture."""
    return data.startswith((b"#?RADIANCE", b"#?RGBE"))


def decode_radiance_hdr(data: bytes) -> Picture:
    """Decode a Radiance picture of any of the eight orientations.

    The header is read here; the pixels are decoded by OpenCV, which knows one orientation and no
    exposure, so it is given a plain header, and orientation and exposure are applied afterwards.
    EXPOSURE and COLORCORR say by what the radiance was multiplied: it is divided out again.

    Raises
    ------
    EnvironmentMapError
        If the header is not understood, the pixels are XYZE, or the data end too early.
    """
    header = _read_header(data)
    body = memoryview(data)[header.body :]
    if not _is_run_length_encoded(body, header.minor):
        body = memoryview(_flat_pixels(body, header.major * header.minor))
    plain = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n" % (header.major, header.minor)
    decoded = _decode_with_opencv(plain + bytes(body))
    if decoded is None or decoded.shape != (header.major, header.minor, 3):
        raise EnvironmentMapError(
            f"the pixels end before {header.major} scanlines of {header.minor} are complete, "
            "or their run lengths are damaged"
        )
    pixels: F32 = decoded[:, :, ::-1]  # OpenCV keeps blue first
    if header.major_axis == "Y":
        top_first, left_first = header.major_sign == "-", header.minor_sign == "+"
    else:
        pixels = pixels.transpose(1, 0, 2)
        top_first, left_first = header.minor_sign == "-", header.major_sign == "+"
    pixels = pixels[:: 1 if top_first else -1, :: 1 if left_first else -1]
    if header.scale != (1.0, 1.0, 1.0):
        pixels = (pixels / np.array(header.scale)).astype(np.float32)
    return Picture(
        pixels=np.ascontiguousarray(pixels, dtype=np.float32),
        format="hdr",
        pixel_type="rgbe",
        channels=("R", "G", "B"),
        facts={} if header.scale == (1.0, 1.0, 1.0) else {"exposure_divided": list(header.scale)},
        warnings=header.warnings,
    )


def _read_header(data: bytes) -> _Header:
    """Read the lines up to and with the resolution string."""
    scale = [1.0, 1.0, 1.0]
    warnings: list[str] = []
    at, in_variables = 0, True
    while True:
        end = data.find(b"\n", at, _MAX_HEADER)
        if end < 0:
            raise EnvironmentMapError(
                "the Radiance header has no resolution line such as -Y 512 +X 1024"
            )
        line, at = data[at:end].strip(), end + 1
        if not in_variables:
            break
        if not line:
            in_variables = False
            continue
        name, _, value = line.decode("latin-1").partition("=")
        match name.strip().upper():
            case "FORMAT" if value.strip() != "32-bit_rle_rgbe":
                raise EnvironmentMapError(
                    f"FORMAT={value.strip()} is not read: only RGB pixels (32-bit_rle_rgbe) are"
                )
            case "EXPOSURE":
                factor = _numbers(line, value, 1)[0]
                scale = [s * factor for s in scale]
            case "COLORCORR":
                scale = [s * f for s, f in zip(scale, _numbers(line, value, 3), strict=True)]
            case "GAMMA" if _numbers(line, value, 1)[0] != 1.0:
                raise EnvironmentMapError(
                    f"GAMMA={value.strip()}: radiance must be linear, gamma 1"
                )
            case "PRIMARIES" if any(float(f) for f in value.split() if _is_number(f)):
                warnings.append(f"PRIMARIES={value.strip()} left unused: taken as Rec.709")
    match = _RESOLUTION.match(line)
    if match is None or match[2] == match[5]:
        raise EnvironmentMapError(
            f"the resolution line {line[:60]!r} is not of the form -Y 512 +X 1024"
        )
    major, minor = int(match[3]), int(match[6])
    check_size(minor, major)
    return _Header(
        major_axis=match[2].decode(),
        major_sign=match[1].decode(),
        minor_sign=match[4].decode(),
        major=major,
        minor=minor,
        body=at,
        scale=(scale[0], scale[1], scale[2]),
        warnings=tuple(warnings),
    )


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(line: bytes, value: str, count: int) -> list[float]:
    """Read ``count`` positive numbers of a header line."""
    fields = value.split()
    if len(fields) < count or not all(_is_number(f) for f in fields[:count]):
        raise EnvironmentMapError(f"the header line {line[:60]!r} is not understood")
    numbers = [float(f) for f in fields[:count]]
    if not all(math.isfinite(n) and n > 0 for n in numbers):
        raise EnvironmentMapError(f"the header line {line[:60]!r} must hold positive numbers")
    return numbers


def _is_run_length_encoded(body: memoryview, minor: int) -> bool:
    """Tell whether the first scanline has the marks of the newer, per-component encoding."""
    if not 8 <= minor <= 0x7FFF or len(body) < 4:
        return False
    return body[0] == 2 and body[1] == 2 and (body[2] << 8 | body[3]) == minor


def _flat_pixels(body: memoryview, n_pixels: int) -> bytes:
    """Undo the old run-length encoding, in which (1, 1, 1, n) repeats the pixel before n times.

    Several such pixels in a row give a count with 8 more bits each.  A flat body has none of them
    and comes back as it is.
    """
    codes = np.frombuffer(body[: len(body) // 4 * 4], dtype=np.uint8).reshape(-1, 4)
    is_repeat = (codes[:, :3] == 1).all(axis=1)
    if len(codes) and is_repeat[0]:
        raise EnvironmentMapError("the pixels begin with a repeat of nothing")
    source = np.maximum.accumulate(np.where(is_repeat, 0, np.arange(len(codes))))
    shift = np.maximum(np.arange(len(codes)) - source - 1, 0) * 8
    counts = np.where(is_repeat, codes[:, 3].astype(np.int64) << np.minimum(shift, 32), 1)
    ends = np.cumsum(np.minimum(counts, n_pixels))
    if not len(codes) or ends[-1] < n_pixels:
        raise EnvironmentMapError(
            f"the pixels end early: {int(ends[-1]) if len(codes) else 0} of {n_pixels} are there"
        )
    last = int(np.searchsorted(ends, n_pixels)) + 1
    counts = np.minimum(counts[:last], n_pixels)
    return bytes(codes[np.repeat(source[:last], counts)[:n_pixels]])


def _decode_with_opencv(data: bytes) -> F32 | None:
    """Decode, or give None where OpenCV finds the data damaged."""
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        return None
    return None if decoded is None else np.asarray(decoded, dtype=np.float32)
