"""Lights add up on one map, and keep their power and place."""

import numpy as np
import pytest

from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.errors import SettingsError
from prtbake_workers.environment.environment import LUMINANCE, Environment
from prtbake_workers.environment.summing import AddedLight, sum_environments


def noise(rng, height, width):
    return Environment((rng.random((height, width, 3)) ** 4).astype(np.float32))


def test_a_lone_light_comes_back_bit_for_bit(rng):
    own = noise(rng, 16, 32)
    assert np.array_equal(sum_environments([AddedLight(own)]).radiance, own.radiance)
    with pytest.raises(ValueError, match="no lights"):
        sum_environments([])


def test_equal_maps_are_added_texel_by_texel(rng):
    a, b = noise(rng, 16, 32), noise(rng, 16, 32)
    both = sum_environments([AddedLight(a), AddedLight(b, 0.25)])
    expected = a.radiance.astype(np.float64) + 0.25 * b.radiance.astype(np.float64)
    assert np.array_equal(both.radiance, expected.astype(np.float32))


def test_a_smaller_map_is_cut_and_looks_the_same(rng):
    small, large = noise(rng, 8, 16), noise(rng, 16, 32)
    both = sum_environments([AddedLight(large), AddedLight(small)])
    assert (both.height, both.width) == (16, 32)
    expected = large.radiance + np.repeat(np.repeat(small.radiance, 2, axis=0), 2, axis=1)
    # float32 sums
    assert np.allclose(both.radiance, expected, rtol=1e-6)


def test_maps_of_other_shapes_keep_their_power(rng):
    """24 rows do not go into 32, nor 50 columns into 48."""
    lights = [AddedLight(noise(rng, 32, 48), 2.0), AddedLight(noise(rng, 24, 50), 3.0)]
    both = sum_environments(lights)
    assert (both.height, both.width) == (32, 50)
    power = float(both.mean_radiance @ LUMINANCE)
    # float32 texels
    assert power == pytest.approx(sum(light.power for light in lights), rel=1e-6)
    # negative twin: to repeat the nearest rows and columns is 4e-4 off
    rows = (np.arange(32) * 24) // 32
    columns = (np.arange(50) * 48) // 50
    near = Environment(2.0 * lights[0].environment.radiance[:, columns]).mean_radiance
    near = near + Environment(3.0 * lights[1].environment.radiance[rows]).mean_radiance
    assert float(near @ LUMINANCE) != pytest.approx(power, rel=1e-4)


def test_a_light_is_turned_by_itself():
    """A lamp stands where its own turn takes it; the light that it is added to stays."""
    lamp, dark = np.zeros((32, 64, 3), np.float32), np.zeros((32, 64, 3), np.float32)
    lamp[14:18, 30:34] = 100.0  # around -z
    dark[2, 5] = 7.0
    rotation = rotation_matrix((0.0, 90.0, 0.0))
    both = sum_environments(
        [AddedLight(Environment(dark)), AddedLight(Environment(lamp), 0.5, rotation)]
    )
    towards = rotation @ np.array([0.0, 0.0, -1.0])
    assert both.lookup(towards[None, :])[0] == pytest.approx([50.0] * 3, rel=1e-6)
    assert both.lookup(np.array([[0.0, 0.0, -1.0]]))[0] == pytest.approx([0.0] * 3)
    assert both.radiance[2, 5] == pytest.approx([7.0] * 3)


def test_a_light_that_no_map_holds_is_named(rng):
    bright = Environment(np.full((4, 8, 3), 1e34, np.float32))
    added = [AddedLight(noise(rng, 8, 16)), AddedLight(bright, 1e3), AddedLight(bright, 1e6)]
    with pytest.raises(SettingsError, match=r"scale 1e\+06 of light 1 makes") as refused:
        sum_environments(added)
    assert refused.value.pointer == "/lights/1/scale"
    # the largest that float32 holds is no fault
    assert np.isfinite(sum_environments(added[:2]).radiance).all()
