"""Errors that are asked for: every method ends just below them, or says what the best is."""

from typing import NamedTuple

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress import pca
from prtbake_workers.compress.methods import Fit, compress
from prtbake_workers.compress.to_error import Scaled, _at, compress_to_error


class Sizes(NamedTuple):
    n_clusters: int = 6
    ranks: tuple[int, int, int] = (4, 12, 8)
    n_components: int = 4


def fit_of(weights, **changes):
    return Fit(seed=1, max_iterations=6, vertex_weights=weights, **changes)


def measured(rows, model, weights):
    difference = (model.reconstruct().reshape(rows.shape) - rows).astype(float)
    energy = weights @ np.sum(np.square(rows, dtype=float), axis=(1, 2))
    return weights @ np.sum(difference**2, axis=(1, 2)) / energy


@pytest.fixture(scope="module")
def weights():
    return np.random.default_rng(3).uniform(0.5, 2.0, 600)


@pytest.mark.parametrize("target", [0.1, 0.02, 0.004])
@pytest.mark.parametrize("method", ["pca", "cpca", "cta"])
def test_the_error_ends_within_a_tenth_below_the_target(method, target, glossy, weights):
    found = compress_to_error(method, glossy, Sizes(), fit_of(weights), target).model
    assert 0.9 * target < found.squared_error_ratio <= target
    assert measured(glossy, found, weights) <= target


def test_a_search_of_pca_decomposes_once(glossy, weights, monkeypatch):
    sums = []
    whole = pca._gram
    monkeypatch.setattr(pca, "_gram", lambda *given: sums.append(1) or whole(*given))
    tried = []
    fits = pca.Principal.model
    monkeypatch.setattr(
        pca.Principal, "model", lambda *given, **more: tried.append(1) or fits(*given, **more)
    )
    found = compress_to_error("pca", glossy, Sizes(), fit_of(weights), 0.004).model
    assert measured(glossy, found, weights) <= 0.004
    assert (len(sums), len(tried) > 1) == (1, True)


def test_colours_meet_their_target(coloured, weights):
    fit = fit_of(weights, n_channels=3)
    found = compress_to_error("cta", coloured, Sizes(), fit, 0.05).model
    assert 0.9 * 0.05 < measured(coloured, found, weights) <= 0.05


@pytest.mark.parametrize("target", [0.3, 0.1])
def test_vector_quantisation_ends_near_the_target(target, diffuse, weights):
    rows = diffuse[:, None]
    found = compress_to_error("vq", rows, Sizes(), fit_of(weights), target).model
    assert 0.8 * target < measured(rows, found, weights) <= target


def test_smaller_errors_take_more_bytes(glossy, weights):
    sizes = [
        compress_to_error("cta", glossy, Sizes(), fit_of(weights), target).model.nbytes
        for target in (0.1, 0.02, 0.004)
    ]
    assert sizes == sorted(sizes)
    assert sizes[2] > 2 * sizes[0]


def test_a_start_far_too_large_comes_down(glossy, weights):
    """Trimming alone would leave bases of the light that nothing needs."""
    large = Sizes(ranks=(9, 70, 60))
    found = compress_to_error("cta", glossy, large, fit_of(weights), 0.05).model
    plain = compress_to_error("cta", glossy, Sizes(), fit_of(weights), 0.05).model
    assert found.nbytes < 1.3 * plain.nbytes
    untrimmed = compress("cta", glossy, large, fit_of(weights)).model
    assert found.nbytes < 0.2 * untrimmed.nbytes


def test_a_target_that_cannot_be_met_names_the_best(rng):
    """Noise in float32: no rank below the full one leaves less than 1e-16."""
    rows = rng.standard_normal((40, 1, 30)).astype(np.float32)
    with pytest.raises(
        SettingsError, match=r"cannot be met by pca: the best of .* leaves"
    ) as caught:
        compress_to_error("pca", rows, Sizes(), fit_of(None), 1e-20)
    assert caught.value.pointer == "/max_error"


@pytest.mark.parametrize("target", [0.0, -1.0, 1.0, float("nan")])
def test_a_target_out_of_range_is_refused(target, diffuse):
    with pytest.raises(SettingsError, match="above 0 and below 1"):
        compress_to_error("pca", diffuse[:, None], Sizes(), fit_of(None), target)


@pytest.mark.parametrize("classification", ["static", "iterative"])
@pytest.mark.parametrize("seed", range(6))
def test_more_iterations_than_the_trial_s_break_no_promise(classification, seed):
    """Few vertices in many clusters: the full fit may leave more than the trial that met the target."""
    rng = np.random.default_rng(seed)
    bumps = rng.standard_normal((5, 30))
    rows = np.repeat(bumps, 60, axis=0) + 0.5 * rng.standard_normal((300, 30))
    fit = Fit(seed=seed, max_iterations=10, classification=classification)
    sizes = Sizes(n_components=2)
    signal = rows.astype(np.float32)[:, None]
    found = compress_to_error("cpca", signal, sizes, fit, 0.1).model
    assert found.squared_error_ratio <= 0.1


def test_sizes_never_hold_more_numbers_than_the_transfer(rng):
    rows = rng.standard_normal((60, 1, 40)).astype(np.float32)
    for method in ("pca", "cpca", "cta"):
        with pytest.raises(SettingsError, match="cannot be met"):
            compress_to_error(method, rows, Sizes(n_clusters=2), fit_of(None), 1e-12)
        start = Scaled(2, (1, 12, 8), 4)
        sizes = _at(64.0, start, method, rows.shape)
        model = compress(method, rows, sizes, fit_of(None)).model
        assert model.nbytes <= 1.1 * rows.nbytes
