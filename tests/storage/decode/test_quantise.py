"""Sixteen bits: half a step at most, exact in float32, small columns kept."""

import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.quantise import (
    pack_tangents,
    quantise,
    quantise_asset,
    quantise_weights,
    unpack_frames,
)


def test_error_is_half_a_step_of_its_own_column(rng: np.random.Generator) -> None:
    array = (rng.normal(size=(3, 200, 4)) * 10.0 ** -np.arange(0, 8, 2)).astype(np.float32)
    array[1, :, 2] = 0.0
    packed = quantise(array, (1,))
    assert packed.scale.shape == (3, 1, 4)
    error = np.abs(packed.dequantised() - array)
    assert (error <= 0.5001 * packed.scale).all()
    peak = np.abs(array).max(axis=1, keepdims=True)
    assert (packed.scale <= peak / 32767 * (1 + 2**-8)).all()
    assert (packed.dequantised()[1, :, 2] == 0).all()
    # negative twin: one scale for all loses the smallest column altogether
    shared = quantise(array, (0, 1, 2)).dequantised()
    assert np.abs(shared - array)[..., 3].max() > 0.5 * peak[..., 3].max()


def test_values_are_exact_in_float32(rng: np.random.Generator) -> None:
    packed = quantise(rng.normal(size=(50, 30)).astype(np.float32), (0,))
    exact = packed.values.astype(np.float64) * packed.scale.astype(np.float64)
    np.testing.assert_array_equal(packed.dequantised(), exact)


@pytest.mark.parametrize("size", [1e-44, 1e-20, 1e-3, 1e30, 3e38])
def test_extremes_stay_finite(size: float) -> None:
    array = np.full((3, 2), size, np.float32)
    array[0] *= -1
    back = quantise(array, (0,)).dequantised()
    assert np.isfinite(back).all()
    # scales below 2^-120 are taken for zero
    assert np.abs(back - array).max() <= max(2e-5 * size, 1e-31)


def test_weights_take_the_scale_of_their_cluster(rng: np.random.Generator) -> None:
    labels = np.array([0, 0, 1, 1], np.int32)
    weights = np.array([[1.0, 0.1], [2.0, 0.2], [1e-4, 1e-5], [3e-4, 0.0]], np.float32)
    values, scale = quantise_weights(weights, labels, 3)
    np.testing.assert_allclose(values * scale[labels], weights, rtol=1e-4)
    assert (scale[2] == 0).all()


def test_frames_survive_as_tangents(asset: Asset) -> None:
    part = asset.parts[0]
    assert part.frames is not None
    normals = asset.normals[: part.n_vertices]
    back = unpack_frames(pack_tangents("object", part.frames, normals), normals)
    # a step of 1/32767 on each axis
    np.testing.assert_allclose(back, part.frames, atol=5e-5)
    mirrored = part.frames.copy()
    mirrored[7, 1] *= -1
    with pytest.raises(ValueError, match="vertex 7 is not right-handed"):
        pack_tangents("object", mirrored, normals)


def test_only_16_and_32_bits(asset: Asset) -> None:
    assert quantise_asset(asset, 32) is asset
    with pytest.raises(ValueError, match="bits is 8"):
        quantise_asset(asset, 8)
