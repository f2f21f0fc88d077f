"""Sixteen bits: bound and measured error."""

import numpy as np
import pytest

from prtbake_storage.decode.quantise import SMALLEST_SCALE, quantise
from prtbake_storage.errors import SettingsError
from prtbake_workers.transport.quantise import CHUNK_NUMBERS, ERROR_BOUND, quantise_transfer


def coefficients(rng, n_verts=300):
    """Brightness over eight decades, terms falling, a few outliers."""
    values = rng.normal(size=(n_verts, 4, 162)) ** 3
    values *= 10.0 ** rng.uniform(-8, 0, (n_verts, 1, 1)) * 0.1 ** np.arange(4)[:, None]
    return values.astype(np.float32)


def test_error_is_measured_and_bounded(rng):
    signal = coefficients(rng)
    packed = quantise_transfer(signal)
    error = signal.astype(np.float64) - packed.dequantised()
    np.testing.assert_allclose(packed.squared_error, (error**2).sum(axis=(1, 2)), rtol=1e-12)
    assert packed.max_error == np.abs(error).max()
    assert packed.rms_error == pytest.approx(np.sqrt((error**2).mean()), rel=1e-12)
    rows = (error**2).sum(axis=2) / (signal.astype(np.float64) ** 2).sum(axis=2)
    # each row by itself, however dark: far below 1e-4
    assert rows.max() <= 162 * ERROR_BOUND < 5e-8
    # negative twin: one scale for all loses the dark rows altogether
    step = np.abs(signal).max() / 32767
    coarse = np.rint(signal / step) * step - signal
    assert ((coarse**2).sum(axis=2) / (signal**2).sum(axis=2)).max() > 0.5


def rows_by_kind(rng):
    """Rows that rounding may treat otherwise, by what they hold."""
    faint = coefficients(rng, 8)
    # about the peak below which a step would be denormal, and at it
    faint *= 32767 * SMALLEST_SCALE / np.abs(faint).max(axis=2, keepdims=True)
    faint[:, 0] *= np.float32(0.5)
    faint[:, 1] *= np.float32(2.0)
    steps = rng.integers(-32766, 32767, (8, 4, 162)) + rng.choice([-0.5, 0.5], (8, 4, 162))
    steps[..., 0] = 32767.0
    return {
        "brightness over eight decades": coefficients(rng),
        "steps about the smallest": faint,
        "halves of a step": (steps * 2.0**-20).astype(np.float32),
        "a vertex at a time": rng.normal(size=(3, 2, CHUNK_NUMBERS // 2 + 1)).astype(np.float32),
        "no more than signs": rng.choice([-1.0, 0.0, 1.0], (8, 4, 162)).astype(np.float32),
    }


def test_numbers_are_rounded_as_those_of_an_asset_are(rng):
    for kind, signal in rows_by_kind(rng).items():
        packed, plain = quantise_transfer(signal), quantise(signal, (2,))
        np.testing.assert_array_equal(packed.values, plain.values, err_msg=kind)
        np.testing.assert_array_equal(packed.scale, plain.scale[:, :, 0], err_msg=kind)
        # float32 holds every difference: none is rounded
        error = signal.astype(np.float64) - plain.dequantised()
        np.testing.assert_allclose(
            packed.squared_error, (error**2).sum(axis=(1, 2)), rtol=1e-12, err_msg=kind
        )
        assert packed.max_error == np.abs(error).max(), kind


def test_rows_about_the_smallest_step_and_halves_are_what_they_are_said_to_be(rng):
    """Negative twin: each of them is where another rule rounds otherwise."""
    kinds = rows_by_kind(rng)
    faint = quantise_transfer(kinds["steps about the smallest"])
    assert not faint.scale[:, 0].any()
    assert not faint.values[:, 0].any()
    assert (faint.scale[:, 1] > 0.0).all()
    assert (np.abs(faint.values[:, 1]).max(axis=1) > 16_000).all()
    halves = kinds["halves of a step"]
    packed = quantise_transfer(halves)
    assert (packed.scale == 2.0**-20).all()
    assert (packed.values[..., 1:] % 2 == 0).all()
    up = np.floor(halves * 2.0**20 + 0.5)
    assert 0.4 < (packed.values != up).mean() < 0.6


def test_bytes_do_not_depend_on_the_blocks(rng):
    signal = coefficients(rng)
    whole = quantise_transfer(signal)
    parts = [quantise_transfer(signal[:77]), quantise_transfer(signal[77:])]
    np.testing.assert_array_equal(whole.values, np.concatenate([p.values for p in parts]))
    np.testing.assert_array_equal(whole.scale, np.concatenate([p.scale for p in parts]))


def test_threads_change_nothing(rng):
    signal = coefficients(rng)
    alone, shared = quantise_transfer(signal), quantise_transfer(signal, threads=3)
    np.testing.assert_array_equal(alone.values, shared.values)
    np.testing.assert_array_equal(alone.scale, shared.scale)
    np.testing.assert_array_equal(alone.squared_error, shared.squared_error)
    assert (alone.max_error, alone.rms_error) == (shared.max_error, shared.rms_error)


def test_zeros_stay_zeros():
    packed = quantise_transfer(np.zeros((3, 2, 12), np.float32))
    assert not packed.values.any()
    assert packed.max_error == packed.rms_error == 0.0
    np.testing.assert_array_equal(packed.dequantised(), 0.0)
    empty = quantise_transfer(np.zeros((0, 2, 12), np.float32))
    assert empty.values.shape == (0, 2, 12)
    assert empty.rms_error == 0.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_coefficients_are_named(bad, rng):
    signal = coefficients(rng)
    signal[270, 2, 5] = bad
    with pytest.raises(SettingsError, match="coefficient 5 of term 2 of vertex 270 is not finite"):
        quantise_transfer(signal)
