"""Box filter and resampling keep the light's energy and place."""

import numpy as np
import pytest

from prtbake_storage.decode.relight import rotation_matrix
from prtbake_workers.environment.environment import (
    Environment,
    lat_long_directions,
    lat_long_solid_angles,
)
from prtbake_workers.environment.resampling import box_filter, node_edges, resample


def noisy_map(rng, height: int, width: int) -> Environment:
    radiance = rng.random((height, width, 3)) ** 8
    radiance[height // 3, width // 5] = 1e4
    return Environment(radiance.astype(np.float32))


@pytest.mark.parametrize("size", [(16, 32), (15, 31), (64, 128), (7, 300)])
def test_box_filter_keeps_the_integral_for_any_size(rng, size) -> None:
    environment = noisy_map(rng, 32, 64)
    filtered = Environment(box_filter(environment.radiance, *size))
    # float32 texels, of which the brightest holds most of the light: 6e-8 of it
    assert filtered.mean_radiance == pytest.approx(environment.mean_radiance, rel=3e-7)


def test_averaging_rows_alike_does_not_keep_it(rng) -> None:
    environment = noisy_map(rng, 32, 64)
    plain = environment.radiance.reshape(4, 8, 64, 3).mean(axis=1)
    means = Environment(plain).mean_radiance, environment.mean_radiance
    assert means[0] != pytest.approx(means[1], rel=1e-3)


def test_box_filter_of_nodes_keeps_their_integral(rng) -> None:
    pixels = rng.random((9, 17, 3)).astype(np.float32)
    rows = -np.diff(np.cos(node_edges(9) * np.pi))
    columns = np.diff(node_edges(17))
    expected = np.einsum("y,x,yxc->c", rows, columns, pixels) / 2
    filtered = Environment(box_filter(pixels, 8, 16, nodes=True))
    assert filtered.mean_radiance == pytest.approx(expected, rel=1e-6)


def test_resampling_to_the_same_map_changes_nothing(rng) -> None:
    environment = noisy_map(rng, 16, 32)
    again = resample(environment.lookup, 16, 32)
    # the mean of equal float64 values, rounded to float32
    assert np.allclose(again, environment.radiance, rtol=2e-7, atol=0)


def test_a_turned_sun_stands_where_the_rotation_takes_it_with_its_energy(rng) -> None:
    height, width = 64, 128
    radiance = np.zeros((height, width, 3), dtype=np.float32)
    radiance[20:22, 40:42] = 1000.0
    sun = Environment(radiance)
    rotation = rotation_matrix((20.0, -35.0, 50.0))
    turned = Environment(resample(sun.lookup, height, width, rotation=rotation))
    # 4 texels of sun: their rim is followed to 1/16 of a texel
    assert turned.mean_radiance == pytest.approx(sun.mean_radiance, rel=5e-3)

    def centre(environment):
        weights = environment.luminance.ravel() * lat_long_solid_angles(height, width)
        mean = weights @ lat_long_directions(height, width)
        return mean / np.linalg.norm(mean)

    wanted = rotation @ centre(sun)
    assert centre(turned) == pytest.approx(wanted, abs=2e-3)
    assert centre(turned) != pytest.approx(rotation.T @ centre(sun), abs=2e-2)
