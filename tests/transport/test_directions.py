"""Cube map directions and their weights."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.transport.directions import cube_directions


@pytest.mark.parametrize("resolution", [1, 2, 7, 32])
def test_weights_cover_the_sphere(resolution):
    cube = cube_directions(resolution)
    assert cube.n == 6 * resolution**2
    assert cube.weights.sum() == pytest.approx(4 * np.pi, rel=1e-14)
    np.testing.assert_allclose(np.linalg.norm(cube.directions, axis=1), 1.0, rtol=1e-14)
    assert len(np.unique(cube.directions.round(9), axis=0)) == cube.n


def test_one_point_rule_misses_by_what_is_known():
    points = cube_directions(32).directions
    # |p| of a point of the cube is one over its largest component
    raw = 4.0 / 32**2 * np.abs(points).max(axis=1) ** 3
    assert raw.sum() / (4 * np.pi) == pytest.approx(1.00024, abs=5e-6)


def test_quadrature_integrates_the_second_moments():
    cube = cube_directions(32)
    moments = np.einsum("d,di,dj->ij", cube.weights, cube.directions, cube.directions)
    # the rule is of second order: 1e-3 at this resolution; equal weights miss by 7 % off-diagonal
    np.testing.assert_allclose(moments, 4 * np.pi / 3 * np.eye(3), rtol=0, atol=1e-3)
    fourth = float(cube.weights @ cube.directions[:, 0] ** 4)
    assert fourth == pytest.approx(4 * np.pi / 5, rel=1e-3)
    equal = float(np.mean(cube.directions[:, 0] ** 4) * 4 * np.pi)
    assert equal != pytest.approx(4 * np.pi / 5, rel=0.02)


def test_sub_directions_stay_in_their_texels():
    cube = cube_directions(4)
    samples = cube.sub_directions(3)
    assert samples.shape == (9, 96, 3)
    largest = np.abs(samples).max(axis=2, keepdims=True)
    on_cube = samples / largest
    centre = cube.directions / np.abs(cube.directions).max(axis=1, keepdims=True)
    # half a texel is 1/4, the outer samples lie a third of a texel (1/6) from the centre
    assert np.abs(on_cube - centre).max() == pytest.approx(1 / 6, rel=1e-5)
    np.testing.assert_allclose(on_cube.mean(axis=0), centre, rtol=0, atol=1e-6)
    np.testing.assert_allclose(cube.sub_directions(1)[0], cube.directions, rtol=0, atol=1e-7)


def test_bad_counts_are_refused():
    with pytest.raises(SettingsError, match="cube_resolution"):
        cube_directions(0)
    with pytest.raises(SettingsError, match="supersample"):
        cube_directions(2).sub_directions(0)
