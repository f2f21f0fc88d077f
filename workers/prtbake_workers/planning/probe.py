"""Where sparse probes begin."""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64


def draw_by_area(
    areas: Float64[F64, " verts"], count: int, rng: np.random.Generator
) -> Int64[I64, " count"]:
    """Draw vertices with a probability proportional to their areas, evenly spread (systematic)."""
    cumulative = np.cumsum(np.maximum(areas, 0.0))
    if not cumulative[-1] > 0.0:
        return np.arange(count)
    at = (np.arange(count) + rng.random()) / count * cumulative[-1]
    found = np.searchsorted(cumulative, at, side="right")
    return np.asarray(np.minimum(found, len(areas) - 1), np.int64)
