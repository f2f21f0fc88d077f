"""The hemi-octahedral map: one to one, continuous at the horizon, read bilinearly."""

import numpy as np
import pytest

from prtbake_storage.decode.view_map import (
    hemi_octahedral,
    hemi_octahedral_inverse,
    lookup,
    texel_centres,
)


def upper(rng: np.random.Generator, n: int) -> np.ndarray:
    d = rng.normal(size=(n, 3))
    d[:, 2] = np.abs(d[:, 2])
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def test_there_and_back(rng: np.random.Generator) -> None:
    d = upper(rng, 1000)
    uv = hemi_octahedral(d)
    assert uv.min() >= 0.0
    assert uv.max() <= 1.0
    np.testing.assert_allclose(hemi_octahedral_inverse(uv), d, atol=1e-14)
    # negative twin: the two axes exchanged
    assert np.abs(hemi_octahedral_inverse(uv[:, ::-1]) - d).max() > 0.1


def test_landmarks() -> None:
    assert hemi_octahedral(np.array([0.0, 0.0, 1.0])).tolist() == [0.5, 0.5]
    # x points to the corner (1, 1), y to (1, 0): see the formula in the module
    assert hemi_octahedral(np.array([1.0, 0.0, 0.0])).tolist() == [1.0, 1.0]
    assert hemi_octahedral(np.array([0.0, 1.0, 0.0])).tolist() == [1.0, 0.0]
    assert hemi_octahedral(np.array([-1.0, 0.0, 0.0])).tolist() == [0.0, 0.0]


def test_below_the_horizon_is_the_horizon() -> None:
    low, edge = np.array([0.6, 0.0, -0.8]), np.array([1.0, 0.0, 0.0])
    np.testing.assert_array_equal(hemi_octahedral(low), hemi_octahedral(edge))
    assert np.isfinite(hemi_octahedral(np.array([0.0, 0.0, -1.0], np.float32))).all()


@pytest.mark.parametrize("resolution", [1, 2, 16])
def test_texel_centres_read_texels(rng: np.random.Generator, resolution: int) -> None:
    texture = rng.random((resolution, resolution, 2, 3)).astype(np.float32)
    centres = texel_centres(resolution).reshape(-1, 2)
    read = lookup(texture, centres).reshape(texture.shape)
    np.testing.assert_allclose(read, texture, atol=1e-6)


def test_lookup_is_linear_between_centres_and_clamped_beyond() -> None:
    size = 8
    centres = texel_centres(size)
    texture = (3.0 * centres[..., 0] - 2.0 * centres[..., 1]).astype(np.float32)[..., None]
    inside = np.array([[0.3, 0.4], [0.51, 0.77]])
    # float32 sums of numbers of order 3
    np.testing.assert_allclose(lookup(texture, inside)[:, 0], inside @ [3.0, -2.0], atol=1e-6)
    corner = lookup(texture, np.array([[0.0, 1.0]]))
    assert corner[0, 0] == texture[-1, 0, 0]
