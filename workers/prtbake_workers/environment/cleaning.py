"""Pixels that cannot be light: not finite, negative, or beyond what float32 can carry on."""

from dataclasses import dataclass

import numpy as np

from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.arrays import B8, F32, Bool, Float32

MAX_RADIANCE = 1e18
"""Largest radiance taken: its square still fits float32 with room for the sum of a map."""

MAX_REPAIRED_SHARE = 0.05
"""Share of pixels that repair may touch: beyond it the picture is damaged, not blemished."""

_PLACES_NAMED = 5


@dataclass(frozen=True)
class Cleaning:
    """What was found and done, counted in pixels."""

    n_non_finite: int = 0
    non_finite_places: tuple[str, ...] = ()
    n_negative: int = 0
    most_negative: float = 0.0


def clean_pixels(
    pixels: Float32[F32, "height width 3"], *, repair_non_finite: bool, clamp_negative: bool
) -> tuple[Float32[F32, "height width 3"], Cleaning]:
    """Refuse or mend what is not finite, clamp or refuse what is negative.

    A pixel that is not finite becomes, as a whole, the median of the finite pixels around it, in
    the smallest window that holds one.

    Raises
    ------
    EnvironmentMapError
        Names the first places (x, y, channel) and how many there are.
    """
    finite = np.isfinite(pixels)
    places = _places(pixels, ~finite)
    n_non_finite = int((~finite.all(axis=2)).sum())
    if n_non_finite:
        if not repair_non_finite:
            raise EnvironmentMapError(
                f"{n_non_finite} pixels hold NaN or infinity, the first at {'; '.join(places)}: "
                "set repair_non_finite to replace them by the median of their neighbours",
                pointer="/repair_non_finite",
            )
        pixels = _repaired(pixels, np.asarray(finite.all(axis=2)))
    low = pixels < 0
    cleaning = Cleaning(
        n_non_finite=n_non_finite,
        non_finite_places=places,
        n_negative=int(low.any(axis=2).sum()),
        most_negative=float(pixels.min()) if low.any() else 0.0,
    )
    if cleaning.n_negative:
        if not clamp_negative:
            raise EnvironmentMapError(
                f"{cleaning.n_negative} pixels are negative, the first at "
                f"{'; '.join(_places(pixels, low))}: set clamp_negative to make them zero",
                pointer="/clamp_negative",
            )
        pixels = np.maximum(pixels, 0)
    _refuse_overflow(pixels)
    return pixels, cleaning


def _refuse_overflow(pixels: Float32[F32, "height width 3"]) -> None:
    high = pixels > MAX_RADIANCE
    if high.any():
        raise EnvironmentMapError(
            f"{int(high.any(axis=2).sum())} pixels exceed {MAX_RADIANCE:g}, the first at "
            f"{'; '.join(_places(pixels, high))}: their light would overflow float32; scale the map"
        )


def _places(pixels: Float32[F32, "h w 3"], bad: Bool[B8, "h w 3"]) -> tuple[str, ...]:
    """Name the first bad values with their place."""
    return tuple(
        f"(x={x}, y={y}, channel={'RGB'[c]}): {pixels[y, x, c]:g}"
        for y, x, c in np.argwhere(bad)[:_PLACES_NAMED]
    )


def _repaired(pixels: Float32[F32, "h w 3"], good: Bool[B8, "h w"]) -> Float32[F32, "h w 3"]:
    """Replace the pixels that are not good by the median of the good ones nearby."""
    height, width = good.shape
    if (~good).mean() > MAX_REPAIRED_SHARE:
        raise EnvironmentMapError(
            f"{(~good).mean():.0%} of the pixels hold NaN or infinity; at most "
            f"{MAX_REPAIRED_SHARE:.0%} are repaired"
        )
    result = pixels.copy()
    for y, x in np.argwhere(~good):
        for radius in range(1, max(height, width)):
            window = (
                slice(max(0, y - radius), y + radius + 1),
                slice(max(0, x - radius), x + radius + 1),
            )
            if good[window].any():
                result[y, x] = np.median(pixels[window][good[window]], axis=0)
                break
    return result
