"""A decoded HDR picture, before anything is known about its layout."""

from dataclasses import dataclass, field

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.arrays import F32, Float32

MAX_PIXELS = 8192 * 4096
"""Pixels that are decoded at most: 400 MB as float32, four times the largest map kept."""


@dataclass(frozen=True)
class Picture:
    """Pixels as the file holds them, top row first, and what the file says about them."""

    pixels: Float32[F32, "height width 3"]
    format: str
    pixel_type: str
    channels: tuple[str, ...]
    layout_attribute: str | None = None
    facts: dict[str, object] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def check_size(width: int, height: int) -> None:
    """Refuse a picture without pixels or with more than ``MAX_PIXELS``, before it is decoded."""
    if width < 1 or height < 1:
        raise EnvironmentMapError(f"the header says {width} x {height}: there is nothing to read")
    if width * height > MAX_PIXELS:
        raise EnvironmentMapError(
            f"the picture has {width} x {height} pixels; at most {MAX_PIXELS} (8192 x 4096) are "
            "read: scale it down first"
        )
