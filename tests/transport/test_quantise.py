"""Sixteen bits: bound and measured error."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.transport.quantise import ERROR_BOUND, quantise_transfer


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
