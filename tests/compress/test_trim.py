"""Columns left out: the error they add is measured again from the reconstruction."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cta import CtaRanks, compress_cta
from prtbake_workers.compress.trim import column_energies, trimmed


@pytest.fixture(scope="module")
def weights():
    return np.random.default_rng(3).uniform(0.5, 2.0, 600)


@pytest.fixture(scope="module", params=["cta", "cta in colours", "cpca"])
def case(request, glossy, coloured, diffuse, weights):
    if request.param == "cpca":
        return diffuse, compress_cpca(diffuse, 6, 12, seed=1, vertex_weights=weights)
    rows, n_channels = (glossy, 1) if request.param == "cta" else (coloured, 3)
    ranks = CtaRanks(5, 30, 16)
    model = compress_cta(
        rows, 6, ranks, seed=1, max_iterations=3, vertex_weights=weights, n_channels=n_channels
    )
    return rows, model


def measured(signal, model, weights):
    """Squared-error ratio of the reconstruction itself."""
    difference = (model.reconstruct() - signal).astype(float).reshape(len(signal), -1)
    total = weights @ np.sum(np.square(signal.reshape(len(signal), -1), dtype=float), axis=1)
    return (weights @ np.sum(difference**2, axis=1)) / total


@pytest.mark.parametrize("times", [1.2, 3.0, 10.0])
def test_the_error_ends_just_below_what_is_allowed(case, weights, times):
    signal, model = case
    allowed = times * model.squared_error_ratio
    found = trimmed(model, allowed, weights)
    # 6 clusters of a dozen columns: one column is some per cent
    assert 0.9 * allowed < found.squared_error_ratio <= allowed
    # float32 factors, against errors of 1e-3 of the signal
    assert measured(signal, found, weights) == pytest.approx(found.squared_error_ratio, rel=1e-3)
    per_vertex = weights @ found.squared_error_per_vertex / found.initial_energy
    assert per_vertex == pytest.approx(found.squared_error_ratio, rel=1e-6)
    assert found.nbytes < model.nbytes
    assert found.objective == model.objective
    # twin: the same columns of one cluster more would be above what is allowed
    over = trimmed(model, 1.5 * allowed, weights)
    assert measured(signal, over, weights) > allowed


def test_nothing_is_left_out_where_nothing_is_allowed(case, weights):
    _, model = case
    assert trimmed(model, 0.5 * model.squared_error_ratio, weights) is model


def test_columns_of_least_energy_a_float_go_first(case, weights):
    signal, model = case
    allowed = 2.0 * model.squared_error_ratio
    found = trimmed(model, allowed, weights)
    # twin: as much error by cutting the same rank off every cluster keeps more bytes
    ranks = model.ranks if model.ranks.ndim == 1 else model.ranks[:, 2]
    for cut in range(int(ranks.max()), 0, -1):
        kept = np.where(np.arange(model.weights.shape[1]) < cut, model.weights, 0.0)
        even = replace(model, weights=kept.astype(np.float32))
        if measured(signal, even, weights) > allowed:
            break
        floor = even
    own = floor.ranks if floor.ranks.ndim == 1 else floor.ranks[:, 2]
    columns = np.minimum(own, np.count_nonzero(np.abs(floor.weights).sum(axis=0)))
    left = found.ranks if found.ranks.ndim == 1 else found.ranks[:, 2]
    assert left.sum() <= columns.sum()


def test_all_may_go(case, weights):
    signal, model = case
    found = trimmed(model, 1.0 + model.squared_error_ratio, weights)
    assert not found.weights.any()
    assert found.weights.shape[1] == 1
    assert measured(signal, found, weights) == pytest.approx(found.squared_error_ratio, rel=1e-3)


def test_energies_are_those_of_the_columns(case, weights):
    _, model = case
    energies = column_energies(model.weights, model.labels, model.n_clusters, weights)
    for cluster in range(model.n_clusters):
        own = model.labels == cluster
        expected = weights[own] @ np.square(model.weights[own], dtype=float)
        np.testing.assert_allclose(energies[cluster], expected, rtol=1e-12)
    # orthonormal rows: with what is left they are all of the signal about the clusters' means
    assert (np.diff(energies, axis=1) <= 1e-4 * energies[:, :1]).all()
