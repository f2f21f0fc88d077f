"""Rounded factors: half a step at most, exact in float32, small columns kept."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.quantise import (
    NUMBERS_AT_A_TIME,
    bits_of,
    dequantised,
    finest_scale,
    levels,
    pack_tangents,
    peak_scales,
    quantise,
    quantise_asset,
    round_part,
    scale_below,
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


def test_weights_take_the_scale_of_their_cluster(asset: Asset) -> None:
    labels = np.array([0, 0, 1, 1], np.int32)
    weights = np.array([[1.0, 0.1], [2.0, 0.2], [1e-4, 1e-5], [3e-4, 0.0]], np.float32)
    part = replace(
        asset.parts[1], vertex_range=(0, 4), labels=labels, weights=weights,
        ranks=np.ones((3, 3), np.int32),
    )  # fmt: skip
    scale = peak_scales(part, 16)["weights"]
    values = round_part(part, peak_scales(part, 16))["weights"]
    np.testing.assert_allclose(values * scale[labels], weights, rtol=1e-4)
    np.testing.assert_array_equal(
        dequantised("weights", values, scale, labels), values * scale[labels]
    )
    assert (scale[2] == 0).all()


@pytest.mark.parametrize("bits", [2, 5, 8, 12, 16])
def test_every_number_of_bits_is_off_by_half_a_step(asset: Asset, bits: int) -> None:
    part = asset.parts[0]
    scales = peak_scales(part, bits)
    for name, rounded in round_part(part, scales).items():
        step = scales[name][part.labels] if name == "weights" else scales[name]
        back = dequantised(name, rounded, scales[name], part.labels)
        off = np.abs(back - getattr(part, name))
        assert (off <= 0.50001 * step).all()
        # and no finer than the bits are
        assert (off / np.maximum(step, 1e-30)).max() > 0.4
        assert bits_of(rounded) == bits


def test_bits_count_the_sign() -> None:
    given = {0: 1, 1: 2, -1: 2, 2: 3, 3: 3, 127: 8, -127: 8, 128: 9, 32767: 16, -32767: 16}
    assert {value: bits_of(np.array([value], np.int16)) for value in given} == given


def test_reading_levels_takes_no_more_than_their_factor(rng: np.random.Generator) -> None:
    labels = rng.integers(0, 5, 40_000).astype(np.int32)
    stored = rng.integers(-128, 128, (40_000, 50)).astype(np.int8)
    scale = rng.uniform(0.1, 1.0, (5, 50)).astype(np.float32)
    tracemalloc.start()
    factor = dequantised("weights", stored, scale, labels, offset=3)
    bits = bits_of(stored, offset=3)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # all at once: levels in 32 bits, as floats and with their scales are 12 bytes a stored one more
    assert peak < 1.2 * factor.nbytes + 8 * NUMBERS_AT_A_TIME
    expected = (stored.astype(np.int32) - 3).astype(np.float32) * scale[labels]
    np.testing.assert_array_equal(factor, expected)
    assert bits == bits_of(stored.astype(np.int32) - 3) == 9
    bases = rng.integers(-9, 9, (5, 30, 4)).astype(np.int16)
    for shape in ((5, 1, 4), (1, 1, 4)):
        own = rng.uniform(0.1, 1.0, shape).astype(np.float32)
        np.testing.assert_array_equal(
            dequantised("light_bases", bases, own, labels), bases.astype(np.float32) * own
        )


def test_scales_next_to_a_step() -> None:
    steps = np.geomspace(1e-30, 1e30, 400)
    below, above = scale_below(steps), finest_scale(100.0 * steps, 100)
    assert (below <= steps).all()
    assert (above >= steps * (1 - 1e-7)).all()
    # eight bits below the leading one
    np.testing.assert_allclose(below, steps, rtol=2**-8)
    np.testing.assert_allclose(above, steps, rtol=2**-8)
    assert (scale_below(np.array([0.0, 1e-37])) == 0).all()


def test_a_scale_that_is_too_fine_is_refused(asset: Asset) -> None:
    array = np.array([1.0, -2.0], np.float32)
    with pytest.raises(ValueError, match="a level of 2000000 does not fit 16 bits"):
        levels(array, np.full(1, 1e-6, np.float32))
    part = asset.parts[1]
    scales = dict(peak_scales(part, 16))
    scales["means"] = scales["means"] / 2
    with pytest.raises(ValueError, match="receiver/means: a level of 6"):
        round_part(part, scales)
    del scales["means"]
    with pytest.raises(ValueError, match="receiver: no scale for means"):
        round_part(part, scales)


def test_a_scale_of_zero_drops_its_column() -> None:
    array = np.array([[5.0, 5.0]], np.float32)
    np.testing.assert_array_equal(levels(array, np.array([[0.5, 0.0]], np.float32)), [[10, 0]])


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


def test_only_8_16_and_32_bits(asset: Asset) -> None:
    assert quantise_asset(asset, 32) is asset
    with pytest.raises(ValueError, match="bits is 12"):
        quantise_asset(asset, 12)


def test_an_asset_says_how_it_was_rounded(asset: Asset) -> None:
    seen = quantise_asset(asset, 8, [0.25, 0.125])
    for part, error in zip(seen.parts, (0.25, 0.125), strict=True):
        assert part.precision is not None
        assert set(part.precision.bits.values()) == {8}
        assert part.precision.error == error
    assert [part.precision for part in quantise_asset(seen, 32).parts] == [None, None]
