"""Points of equal area on a zone of the sphere."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.geometry.zone import zone_directions


@pytest.mark.parametrize(("n", "lowest"), [(642, -1.0), (642, -0.1), (300, 0.5)])
def test_points_are_unit_spread_and_of_equal_area(n, lowest):
    points = zone_directions(n, lowest)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 1.0, atol=1e-12)
    assert points[:, 1].min() > lowest
    cosines = points @ points.T
    np.fill_diagonal(cosines, -1.0)
    nearest = np.arccos(cosines.max(axis=1))
    spacing = np.sqrt(2.0 * np.pi * (1.0 - lowest) / n)
    # a golden spiral's nearest neighbours: 0.85 to 1.1 of the root of the area of one
    assert nearest.min() > 0.7 * spacing
    assert nearest.max() < 1.3 * spacing
    # equal areas: as many in every belt of equal height, and y averages over the zone
    belts = np.histogram(points[:, 1], bins=6, range=(lowest, 1.0))[0]
    assert np.ptp(belts) <= 1
    assert points[:, 1].mean() == pytest.approx(0.5 * (1.0 + lowest), abs=1e-9)


def test_the_integral_of_a_polynomial_over_the_zone():
    lowest = -0.2
    points = zone_directions(2000, lowest)
    weight = 2.0 * np.pi * (1.0 - lowest) / len(points)
    x2 = np.pi * ((1.0 - lowest) - (1.0 - lowest**3) / 3.0)
    assert weight * np.sum(points[:, 0] ** 2) == pytest.approx(x2, rel=1e-3)
    # the negative twin: the points of another zone
    other = zone_directions(2000, 0.2)
    assert weight * np.sum(other[:, 0] ** 2) != pytest.approx(x2, rel=1e-2)


@pytest.mark.parametrize(("n", "lowest", "name"), [(0, -1.0, "n"), (5, 1.0, "lowest")])
def test_what_has_no_points_is_refused(n, lowest, name):
    with pytest.raises(SettingsError) as caught:
        zone_directions(n, lowest)
    assert caught.value.pointer == f"/{name}"
