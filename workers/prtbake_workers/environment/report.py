"""What was found in an environment file and done to it."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import count_samples
from prtbake_workers.environment.fit.target import FINE_ROWS


@dataclass(frozen=True)
class EnvironmentReport:
    """The facts of a reading, for the resource's ``understood`` field.

    ``energy_ratio`` is the mean luminance of the stored map over that of the file's pixels, each
    weighted by its own solid angle: what resampling gained or lost.
    """

    format: str
    pixel_type: str
    channels: tuple[str, ...]
    source_width: int
    source_height: int
    layout: str
    layout_from: str
    width: int
    height: int
    resampled: bool
    energy_ratio: float
    rotation_deg: tuple[float, float, float]
    n_non_finite_repaired: int
    non_finite_places: tuple[str, ...]
    n_negative_clamped: int
    most_negative: float
    statistics: dict[str, Any]
    facts: dict[str, object] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Give the report as plain JSON values."""
        values = asdict(self)
        for name in ("channels", "rotation_deg", "non_finite_places", "warnings"):
            values[name] = list(values[name])
        return values


def light_statistics(environment: Environment) -> dict[str, Any]:
    """Summarise the light: mean per channel, luminance range, and how concentrated the power is.

    ``samples`` are those that fits move, solve and judge scattered lobes in, as many as are asked
    for and as few as leave an error.
    """
    luminance = environment.luminance.ravel()
    solid_angles = environment.solid_angles()
    order = np.argsort(luminance)[::-1]
    power = (luminance * solid_angles)[order]
    brightest = np.cumsum(solid_angles[order]) <= 4 * np.pi * 1e-3
    total = float(power.sum())
    return {
        "mean_radiance": [float(c) for c in environment.mean_radiance],
        "mean_luminance": total / (4 * np.pi),
        "max_luminance": float(luminance.max()),
        "median_luminance": float(np.median(luminance)),
        "black_share": float(solid_angles[luminance == 0].sum() / (4 * np.pi)),
        # at least the brightest texel, which on a coarse map is wider than 0.1 % of the sphere
        "power_in_brightest_thousandth": (
            float(power[: max(1, int(brightest.sum()))].sum()) / total if total > 0 else 0.0
        ),
        "samples": {
            "number": count_samples(environment),
            "error": count_samples(environment, FINE_ROWS),
        },
    }
