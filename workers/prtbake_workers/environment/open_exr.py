"""OpenEXR pictures: scanline or tiled, half or float, the full-resolution level."""

import io
from typing import Any

import numpy as np
import OpenEXR

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.arrays import F32, Float32
from prtbake_workers.environment.picture import Picture, check_size

_MAGIC = b"\x76\x2f\x31\x01"
_LAYOUTS = {OpenEXR.ENVMAP_LATLONG: "lat_long_exr", OpenEXR.ENVMAP_CUBE: "cube_strip"}
_GREY = ("Y", "G", "R", "B", "L")
_REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06)


def is_open_exr(data: bytes) -> bool:
    """Tell whether the bytes begin like an OpenEXR file."""
    return data.startswith(_MAGIC)


def decode_open_exr(data: bytes) -> Picture:
    """Decode the first flat part: channels R, G, B, or one channel taken as grey.

    Where the file has an ``envmap`` attribute its data window is the map, as OpenEXR defines it;
    otherwise the map is the display window, and what the data window leaves uncovered is black.
    Of a mip-mapped file the full-resolution level is read.

    Raises
    ------
    EnvironmentMapError
        If the file is damaged, deep, sub-sampled, or holds other channels (they are named).
    """
    try:
        headers = OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True).parts
        header: dict[str, Any] = headers[0].header
        _check_part(header)
        parts = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0).parts
        # a part whose pixels are damaged is left out, with a line on stdout and no exception
        if len(parts) != len(headers):
            raise EnvironmentMapError("the OpenEXR file cannot be read: its pixels are damaged")
        part = parts[0]
        channels = {name: channel.pixels for name, channel in part.channels.items()}
        sampling = {(c.xSampling, c.ySampling) for c in part.channels.values()}
    except (RuntimeError, ValueError, TypeError, OverflowError, MemoryError) as error:
        if isinstance(error, EnvironmentMapError):
            raise
        raise EnvironmentMapError(f"the OpenEXR file cannot be read: {error}") from error
    if sampling - {(1, 1)}:
        raise EnvironmentMapError("sub-sampled channels (luminance and chroma) are not read")
    used, warnings = _choose_channels(tuple(channels))
    planes = [np.asarray(channels[name]) for name in used]
    pixel_type = str(planes[0].dtype)
    pixels = np.stack([p.astype(np.float32) for p in planes * (3 // len(planes))], axis=2)
    envmap = header.get("envmap")
    if envmap is None:
        pixels, notes = _fit_display_window(pixels, header)
        warnings += notes
    if len(headers) > 1:
        warnings.append(f"{len(headers)} parts: the first is used")
    warnings += _foreign_primaries(header)
    return Picture(
        pixels=np.ascontiguousarray(pixels),
        format="exr",
        pixel_type=pixel_type,
        channels=used,
        layout_attribute=None if envmap is None else _LAYOUTS.get(envmap),
        facts={"compression": str(header["compression"]).rpartition(".")[2].lower()},
        warnings=tuple(warnings),
    )


def _check_part(header: dict[str, Any]) -> None:
    """Refuse deep data and sizes over the limit before pixels are decoded."""
    if header.get("type") in (OpenEXR.deepscanline, OpenEXR.deeptile):
        raise EnvironmentMapError("a deep OpenEXR picture is not an environment map")
    for window in ("dataWindow", "displayWindow"):
        lower, upper = (np.asarray(corner, dtype=np.int64) for corner in header[window])
        check_size(int(upper[0] - lower[0] + 1), int(upper[1] - lower[1] + 1))


def _choose_channels(names: tuple[str, ...]) -> tuple[tuple[str, ...], list[str]]:
    """Choose R, G, B, or the one channel there is."""
    colours = tuple(name for name in names if name != "A")
    if {"R", "G", "B"} <= set(colours):
        rest = sorted(set(names) - {"R", "G", "B"})
        return ("R", "G", "B"), [f"channels left unused: {', '.join(rest)}"] if rest else []
    if len(colours) == 1 and colours[0] in _GREY:
        return colours, [f"one channel, {colours[0]}, is taken as grey"]
    raise EnvironmentMapError(
        f"channels {', '.join(sorted(names))}: an environment needs R, G and B, or a single one of "
        f"{', '.join(_GREY)}"
    )


def _fit_display_window(
    pixels: Float32[F32, "rows columns 3"], header: dict[str, Any]
) -> tuple[Float32[F32, "height width 3"], list[str]]:
    """Cut or pad the data window to the display window."""
    data_lower, data_upper = (np.asarray(c, dtype=np.int64) for c in header["dataWindow"])
    lower, upper = (np.asarray(c, dtype=np.int64) for c in header["displayWindow"])
    if (data_lower == lower).all() and (data_upper == upper).all():
        return pixels, []
    width, height = (int(n) for n in upper - lower + 1)
    first, last = np.maximum(lower, data_lower), np.minimum(upper, data_upper) + 1
    if (first >= last).any():
        raise EnvironmentMapError("the data window and the display window do not meet")
    canvas = np.zeros((height, width, 3), dtype=np.float32)
    to_x, to_y = (slice(int(a), int(b)) for a, b in zip(first - lower, last - lower, strict=True))
    from_x, from_y = (
        slice(int(a), int(b)) for a, b in zip(first - data_lower, last - data_lower, strict=True)
    )
    canvas[to_y, to_x] = pixels[from_y, from_x]
    uncovered = height * width - int(np.prod(last - first))
    return canvas, [
        f"the data window differs from the display window: {uncovered} pixels have no data: black"
    ]


def _foreign_primaries(header: dict[str, Any]) -> list[str]:
    """Say that primaries other than Rec.709 are not converted (to 0.001, as they are printed)."""
    found = header.get("chromaticities")
    if found is None or np.allclose(found[:6], _REC709, atol=1e-3):
        return []
    return ["the chromaticities attribute differs from Rec.709: values are taken as they are"]
