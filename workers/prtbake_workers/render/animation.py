"""Animated PNG, written frame by frame: nothing but the frame at hand is held."""

import struct
import zlib
from collections.abc import Iterable, Iterator
from fractions import Fraction
from pathlib import Path

from prtbake_workers.arrays import U8, UInt8
from prtbake_workers.render.images import png_bytes

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LARGEST_TERM = 65535


def write_animation(
    path: Path,
    frames: Iterable[UInt8[U8, "height width 3"]],
    n_frames: int,
    frames_per_second: float,
) -> Path:
    """Write frames as an endless animated PNG; return the path.

    Each frame is compressed as a PNG of its own, whose data become a frame of the animation
    (PNG, third edition, 11.3.6: acTL, fcTL and fdAT chunks).

    Parameters
    ----------
    path
        Where to.
    frames
        Pictures of one size; taken one at a time.
    n_frames
        How many they are: the file says so before the first.
    frames_per_second
        Above 0.

    Raises
    ------
    ValueError
        ``frames`` are more or fewer than ``n_frames``, or differ in size.
    """
    delay = Fraction(1.0 / frames_per_second).limit_denominator(_LARGEST_TERM)
    number = count = 0
    size = None
    with path.open("wb") as file:
        for count, frame in enumerate(frames, start=1):
            chunks = list(_chunks(png_bytes(frame)))
            if size is None:
                size = frame.shape
                header = next(data for kind, data in chunks if kind == b"IHDR")
                file.write(_SIGNATURE + _chunk(b"IHDR", header))
                file.write(_chunk(b"acTL", struct.pack(">II", n_frames, 0)))
            elif frame.shape != size:
                raise ValueError(f"frame {count - 1} is {frame.shape}, the first {size}")
            height, width = frame.shape[:2]
            control = (number, width, height, 0, 0, delay.numerator, delay.denominator, 0, 0)
            file.write(_chunk(b"fcTL", struct.pack(">IIIIIHHBB", *control)))
            number += 1
            for data in (data for kind, data in chunks if kind == b"IDAT"):
                if count == 1:
                    file.write(_chunk(b"IDAT", data))
                else:
                    file.write(_chunk(b"fdAT", struct.pack(">I", number) + data))
                    number += 1
        file.write(_chunk(b"IEND", b""))
    if count != n_frames or n_frames == 0:
        raise ValueError(f"{count} frames, not {n_frames}: an animation has one at least")
    return path


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _chunks(png: bytes) -> Iterator[tuple[bytes, bytes]]:
    at = len(_SIGNATURE)
    while at < len(png):
        (length,) = struct.unpack_from(">I", png, at)
        yield png[at + 4 : at + 8], png[at + 8 : at + 8 + length]
        at += 12 + length
