"""The most that the files may take whose bytes go by what pictures show: these, and reports.

Predictions would be guesses: a smooth sky packs to a tenth of what noise does.  PNG and OpenEXR
store what does not pack as it is, so that their size has a bound.
"""

from prtbake_storage.contract.settings import RenderSettings, ValidateSettings
from prtbake_workers.render.images import GAP

HEADER_BYTES = 2000
"""Of any picture: far more than its headers take."""

REPORT_BYTES, PART_BYTES, VIEW_BYTES = 30_000, 6000, 4000
"""Of a report's text: 19 kB of one with two parts and two views are measured."""

PANELS = 3
"""Of a picture of validation: reference, asset, difference."""


def png_at_most(width: int, height: int, channels: int, frames: int = 1) -> int:
    """Bound a PNG of 8 bits, or an animation: rows with a byte before each, in stored blocks."""
    rows = height * (1 + channels * width)
    return frames * (rows + rows // 1000 + HEADER_BYTES)


def exr_at_most(width: int, height: int) -> int:
    """Bound an OpenEXR file of colour and coverage in float32: 16 bytes a row's head and place."""
    return 16 * (width * height + height) + HEADER_BYTES


def preview_files(settings: RenderSettings) -> dict[str, int]:
    """Bound the pictures of a rendering, by name."""
    size = settings.width, settings.height
    found = {}
    for camera in settings.cameras:
        found[f"preview-{camera.name}.png"] = png_at_most(*size, 4)
        found[f"preview-{camera.name}.exr"] = exr_at_most(*size)
    if settings.turntable_frames:
        found["turntable.png"] = png_at_most(*size, 3, settings.turntable_frames)
    return found


def validation_files(settings: ValidateSettings) -> dict[str, int]:
    """Bound the pictures of a validation, by name."""
    lights = len(settings.rotations_deg)
    width = PANELS * settings.width + (PANELS - 1) * GAP
    return {
        f"validation-{camera.name}{'' if lights == 1 else f'-light{light}'}.png": png_at_most(
            width, settings.height, 3
        )
        for camera in settings.cameras
        for light in range(lights)
    }


def with_reports(pictures: dict[str, int], *, n_parts: int) -> dict[str, int]:
    """Add the reports of a job with such pictures: the page holds all but EXR and animation."""
    shown = [
        count
        for name, count in pictures.items()
        if name.endswith(".png") and name != "turntable.png"
    ]
    text = REPORT_BYTES + PART_BYTES * n_parts + VIEW_BYTES * len(shown)
    # as text a picture takes four characters for three bytes
    page = text + sum(4 * (count // 3 + 1) for count in shown)
    return pictures | {"report.json": text, "report.html": page}
