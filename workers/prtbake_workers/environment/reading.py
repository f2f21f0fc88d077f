"""Read an environment file: decode, clean, recognise its layout, bring it to lat-long."""

import numpy as np

from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.arrays import F32, F64, Float32
from prtbake_workers.environment.cleaning import clean_pixels
from prtbake_workers.environment.environment import (
    LUMINANCE,
    Environment,
)
from prtbake_workers.environment.layouts import (
    PIXEL_LAYOUTS,
    Layout,
    layout_of,
    recognise_layout,
)
from prtbake_workers.environment.open_exr import decode_open_exr, is_open_exr
from prtbake_workers.environment.picture import Picture
from prtbake_workers.environment.radiance_hdr import decode_radiance_hdr, is_radiance_hdr
from prtbake_workers.environment.report import EnvironmentReport, light_statistics
from prtbake_workers.environment.resampling import box_filter, resample

MAX_WIDTH = 2048
"""Widest lat-long map kept; wider ones are box filtered to it."""


def read_environment(
    data: bytes,
    *,
    layout: str = "auto",
    repair_non_finite: bool = False,
    clamp_negative: bool = True,
    filename: str | None = None,
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Environment, EnvironmentReport]:
    """Read a Radiance .hdr or an OpenEXR file as distant light.

    Parameters
    ----------
    data
        The file's bytes; the format is told from them.
    layout
        ``auto`` or one of lat_long, lat_long_exr, angular_probe, cube_strip.  What is stated goes
        before what the file says.
    repair_non_finite
        Replace NaN and infinite pixels by the median of their neighbours instead of refusing.
    clamp_negative
        Make negative values zero instead of refusing.
    filename
        Used for nothing but to recognise an angular probe by its name.
    rotation_deg
        Angles about x, y and z, R = Rz Ry Rx; the map is resampled where they are not all zero.

    Raises
    ------
    EnvironmentMapError
        If the file cannot be read or must not be used; says what is wrong and where.
    """
    picture = _decode(data)
    name, evidence = _decide_layout(picture, layout, filename)
    height, width = picture.pixels.shape[:2]
    sampling = layout_of(name, height, width)
    pixels, cleaning = clean_pixels(
        picture.pixels, repair_non_finite=repair_non_finite, clamp_negative=clamp_negative
    )
    radiance, resampled = _to_lat_long(pixels, sampling, rotation_deg)
    environment = Environment(radiance)
    source_mean = _mean_luminance(pixels, sampling.solid_angles)
    mean = _mean_luminance(radiance, environment.solid_angles())
    report = EnvironmentReport(
        format=picture.format,
        pixel_type=picture.pixel_type,
        channels=picture.channels,
        source_width=width,
        source_height=height,
        layout=name,
        layout_from=evidence,
        width=environment.width,
        height=environment.height,
        resampled=resampled,
        energy_ratio=mean / source_mean if source_mean > 0 else 1.0,
        rotation_deg=rotation_deg,
        n_non_finite_repaired=cleaning.n_non_finite,
        non_finite_places=cleaning.non_finite_places,
        n_negative_clamped=cleaning.n_negative,
        most_negative=cleaning.most_negative,
        statistics=light_statistics(environment),
        facts=picture.facts,
        warnings=picture.warnings,
    )
    return environment, report


def _decode(data: bytes) -> Picture:
    if is_radiance_hdr(data):
        return decode_radiance_hdr(data)
    if is_open_exr(data):
        return decode_open_exr(data)
    raise EnvironmentMapError(
        "the file is neither a Radiance picture (#?RADIANCE) nor OpenEXR"
        if data
        else "the file is empty"
    )


def _decide_layout(picture: Picture, layout: str, filename: str | None) -> tuple[str, str]:
    """Take the stated layout, or recognise it."""
    if layout == "auto":
        return recognise_layout(picture, filename)
    if layout not in PIXEL_LAYOUTS:
        raise EnvironmentMapError(
            f"layout {layout!r} is none of auto, {', '.join(PIXEL_LAYOUTS)}", pointer="/layout"
        )
    said = picture.layout_attribute
    disagrees = (
        f"stated, against the file's attribute ({said})" if said not in (None, layout) else ""
    )
    return layout, disagrees or "stated"


def _to_lat_long(
    pixels: Float32[F32, "height width 3"],
    sampling: Layout,
    rotation_deg: tuple[float, float, float],
) -> tuple[Float32[F32, "rows columns 3"], bool]:
    """Bring the pixels to the internal sampling; tell whether they were filtered on the way."""
    width = min(sampling.lat_long_width // 2 * 2, MAX_WIDTH)
    rotation = rotation_matrix(rotation_deg) if any(rotation_deg) else None
    if sampling.pixel_of is None:
        radiance, filtered = _filtered_lat_long(pixels, sampling.name, width)
        if rotation is None:
            return radiance, filtered
        lookup = Environment(radiance).lookup
    else:
        flat, pixel_of = pixels.reshape(-1, 3), sampling.pixel_of

        def lookup(directions: F64) -> F64:
            return flat[pixel_of(directions)].astype(np.float64)

    supersample = 4 if width <= 1024 else 2
    return resample(lookup, width // 2, width, supersample=supersample, rotation=rotation), True


def _filtered_lat_long(
    pixels: Float32[F32, "height width 3"], name: str, width: int
) -> tuple[Float32[F32, "rows columns 3"], bool]:
    """Bring either lat-long layout to the internal one at a width, unchanged where it fits."""
    if name == "lat_long_exr":
        filtered = box_filter(pixels, width // 2, width, nodes=True)
        return np.roll(filtered, width // 2, axis=1), True
    if pixels.shape[1] == width:
        return pixels, False
    return box_filter(pixels, width // 2, width), True


def _mean_luminance(pixels: Float32[F32, "height width 3"], solid_angles: F64) -> float:
    """Average the luminance over the sphere with the pixels' own weights."""
    luminance = pixels.reshape(-1, 3).astype(np.float64) @ LUMINANCE
    return float(luminance @ solid_angles / solid_angles.sum())
