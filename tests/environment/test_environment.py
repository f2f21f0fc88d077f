"""The internal lat-long map: directions, solid angles, lookup."""

import numpy as np
import pytest

from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.errors import EnvironmentMapError
from prtbake_workers.environment.environment import (
    Environment,
    lat_long_directions,
    texel_of,
)


def numbered(height: int, width: int) -> Environment:
    values = np.arange(height * width, dtype=np.float32).reshape(height, width)
    return Environment(np.repeat(values[:, :, None], 3, axis=2))


def test_solid_angles_sum_to_the_sphere_and_give_its_second_moment() -> None:
    environment = numbered(64, 128)
    weights, directions = environment.solid_angles(), environment.directions()
    # exact bands: only rounding of 8192 terms
    assert weights.sum() == pytest.approx(4 * np.pi, rel=1e-13)
    # the integral of y^2 is 4 pi / 3; the midpoint rule is good to (pi / 64)^2 / 24 of it
    moment = weights @ directions[:, 1] ** 2
    assert moment == pytest.approx(4 * np.pi / 3, rel=5e-4)
    flat = np.full_like(weights, 4 * np.pi / len(weights))
    assert flat @ directions[:, 1] ** 2 != pytest.approx(4 * np.pi / 3, rel=5e-4)


@pytest.mark.parametrize(
    ("direction", "u", "v"),
    [
        ((0, 0, -1), 0.5, 0.5),
        ((1, 0, 0), 0.75, 0.5),
        ((-1, 0, 0), 0.25, 0.5),
        ((0, 1, 0), None, 0.0),
        ((0, -1, 0), None, 1.0),
    ],
)
def test_axes_lie_where_the_convention_says(direction, u, v) -> None:
    texel = int(texel_of(np.array([direction], dtype=np.float64), 90, 180)[0])
    row, column = divmod(texel, 180)
    assert row == min(int(v * 90), 89)
    if u is not None:
        assert column == int(u * 180)


def test_every_texel_is_found_at_its_own_centre() -> None:
    texels = texel_of(lat_long_directions(17, 34), 17, 34)
    assert np.array_equal(texels, np.arange(17 * 34))


def test_lookup_is_constant_over_a_texel_and_wraps_at_the_seam(rng) -> None:
    environment = numbered(8, 16)
    y = np.cos(np.pi * (3 + rng.random(50)) / 8)
    azimuth = np.pi - rng.random(50) * 2 * np.pi / 16
    horizontal = np.sqrt(1 - y**2)
    directions = np.stack([horizontal * np.sin(azimuth), y, -horizontal * np.cos(azimuth)], axis=1)
    assert (environment.lookup(directions) == 3 * 16 + 15).all()
    seam = np.array([[0.0, 0.0, 1.0], [-1e-17, 0.0, 1.0]])
    assert set(environment.lookup(seam)[:, 0]) <= {4 * 16, 4 * 16 + 15}


def test_mean_of_a_map_is_weighted_by_solid_angle() -> None:
    radiance = np.zeros((2, 4, 3), dtype=np.float32)
    radiance[0] = 2.0
    assert Environment(radiance).mean_radiance == pytest.approx([1.0] * 3, rel=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf, -1.0])
def test_a_value_that_is_no_radiance_is_refused_with_its_place(value) -> None:
    radiance = np.ones((4, 8, 3), dtype=np.float32)
    radiance[2, 5, 1] = value
    with pytest.raises(EnvironmentMapError, match=r"x=5, y=2\) channel 1"):
        Environment(radiance)


def test_rotation_is_about_x_then_y_then_z() -> None:
    turn = rotation_matrix((90.0, 90.0, 0.0))
    # z -> -y by Rx, and stays under Ry; y -> z by Rx -> x by Ry
    assert turn @ [0, 0, 1] == pytest.approx([0, -1, 0], abs=1e-15)
    assert turn @ [0, 1, 0] == pytest.approx([1, 0, 0], abs=1e-15)
    assert np.linalg.det(turn) == pytest.approx(1.0, rel=1e-12)
