"""The largest coefficients: all of them are the signal, and no other choice is better."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.baselines.largest_coefficients import keep_largest


def squared_error(model, transfer, weights):
    difference = transfer.astype(float) - model.reconstruct()
    return float(weights @ np.einsum("vkt,vkt->v", difference, difference))


def test_all_coefficients_kept_are_the_signal(sampled):
    model = keep_largest(sampled, sampled.size)
    np.testing.assert_array_equal(model.reconstruct(), sampled)
    assert model.objective == [0.0]
    # the dark third costs nothing
    kept = int(np.count_nonzero(sampled))
    assert kept == 80 * 4 * 64
    assert model.nbytes == 6 * kept + 2 * 80 * 4


def test_the_largest_are_kept_by_area(sampled):
    """The slow twin: sort all weighted squares, and add up what is left out."""
    weights = np.where(np.arange(80) < 20, 9.0, 1.0)
    model = keep_largest(sampled, 500, vertex_weights=weights)
    scores = np.sort((weights[:, None, None] * sampled.astype(float) ** 2).ravel())
    assert model.objective[-1] == pytest.approx(scores[:-500].sum(), rel=1e-6)
    assert model.objective[-1] == pytest.approx(squared_error(model, sampled, weights), rel=1e-6)
    assert len(model.values) == int(model.counts.sum()) == 500
    # the negative twin: choosing without the areas leaves more
    plain = keep_largest(sampled, 500)
    assert squared_error(plain, sampled, weights) > 1.05 * model.objective[-1]
    np.testing.assert_array_equal(model.reconstruct(slice(5, 9)), model.reconstruct()[5:9])


def test_what_cannot_be_kept_is_refused(sampled):
    with pytest.raises(SettingsError, match="n_kept"):
        keep_largest(sampled, 0)
    with pytest.raises(SettingsError, match="65536 coefficients"):
        keep_largest(np.ones((1, 1, 65536), np.float32), 1)


def test_a_black_tensor_has_no_error(sampled):
    assert keep_largest(np.zeros_like(sampled), 5).squared_error_ratio == 0.0
