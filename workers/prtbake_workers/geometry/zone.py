"""Near-uniform points on a part of the sphere: where the light comes from that a scene can see."""

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64

GOLDEN_ANGLE = np.pi * (3.0 - 5.0**0.5)


def zone_directions(n: int, lowest: float = -1.0) -> Float64[F64, "dirs 3"]:
    """Lay ``n`` directions of equal area over the part of the sphere above a height.

    Parameters
    ----------
    n
        How many, at least 1.
    lowest
        Least y of the zone, in [-1, 1); -1 is the whole sphere.

    Returns
    -------
    ndarray
        Unit vectors on a spiral from the top down, each a golden angle further round.  Each stands
        for ``2 pi (1 - lowest) / n`` steradians; the nearest neighbours are about
        ``sqrt(2 pi (1 - lowest) / n)`` apart everywhere, the last turns above an edge included.

    Raises
    ------
    SettingsError
        No direction, or a zone without area.
    """
    if n < 1:
        raise SettingsError(f"n must be at least 1, not {n}", pointer="/n")
    if not -1.0 <= lowest < 1.0:
        raise SettingsError(f"lowest must lie in [-1, 1), not {lowest}", pointer="/lowest")
    index = np.arange(n) + 0.5
    y = 1.0 - (1.0 - lowest) * index / n
    radius = np.sqrt(np.maximum(1.0 - y * y, 0.0))
    phi = GOLDEN_ANGLE * index
    return np.column_stack([radius * np.cos(phi), y, radius * np.sin(phi)])
