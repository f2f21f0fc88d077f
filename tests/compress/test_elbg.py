import numpy as np
import pytest

from prtbake_workers.compress.clusters import weighted_mean
from prtbake_workers.compress.elbg import shift_clusters
from prtbake_workers.compress.lbg import Clustering


def _clustering(signal, labels, weights):
    labels = labels.astype(np.int32)
    means = np.stack(
        [weighted_mean(signal[labels == c], weights[labels == c]) for c in range(labels.max() + 1)]
    )
    return Clustering(labels, means, _distances(signal, means, labels))


def _distances(signal, means, labels):
    return np.sum((signal.astype(float) - means[labels].astype(float)) ** 2, axis=1)


def _three_groups(rng):
    """A tight group of 40 vertices and two of 20 far from it; all weights differ."""
    places = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, 6.0]])
    truth = np.repeat([0, 1, 2], [40, 20, 20])
    signal = (places[truth] + 0.1 * rng.standard_normal((80, 2))).astype(np.float32)
    return signal, truth, rng.uniform(0.5, 2.0, 80)


def test_a_cluster_is_shifted_to_where_it_does_more(rng):
    signal, truth, weights = _three_groups(rng)
    # a minimum of LBG: two clusters share the tight group, one holds both others
    labels = np.where(truth == 0, np.where(signal[:, 0] < 0.0, 0, 1), 2)
    state = _clustering(signal, labels, weights)
    before = weights @ state.squared_distances
    assert shift_clusters(signal, state, weights, rng=np.random.default_rng(0)) == 1
    assert len(set(zip(truth.tolist(), state.labels.tolist(), strict=True))) == 3
    for cluster in range(3):
        own = state.labels == cluster
        expected = np.average(signal[own].astype(float), axis=0, weights=weights[own])
        np.testing.assert_allclose(state.means[cluster], expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(
        state.squared_distances, _distances(signal, state.means, state.labels), rtol=1e-4, atol=1e-9
    )
    # what is left is the noise of the groups
    assert weights @ state.squared_distances < 0.01 * before


def test_a_good_clustering_is_left_alone(rng):
    signal, truth, weights = _three_groups(rng)
    state = _clustering(signal, truth, weights)
    labels, means = state.labels.copy(), state.means.copy()
    assert shift_clusters(signal, state, weights, rng=np.random.default_rng(0)) == 0
    np.testing.assert_array_equal(state.labels, labels)
    np.testing.assert_array_equal(state.means, means)


@pytest.mark.parametrize("seed", range(6))
def test_no_shift_raises_the_distortion(seed):
    """From clusters drawn at random, which are as bad as can be, and nearly all are shifted."""
    rng = np.random.default_rng(seed)
    signal = rng.standard_normal((200, 12)).astype(np.float32)
    weights = rng.uniform(0.0, 1.0, 200)
    state = _clustering(signal, rng.permutation(200) % 20, weights)
    before = weights @ state.squared_distances
    shifts = shift_clusters(signal, state, weights, rng=rng)
    after = weights @ _distances(signal, state.means, state.labels)
    assert shifts > 0
    assert after < before
    assert weights @ state.squared_distances == pytest.approx(after, rel=1e-6)
    assert len(np.unique(state.labels)) == 20


def test_merging_is_weighed_with_all_that_it_costs(rng):
    """Splitting the wide group wins less than merging the others loses: no shift."""
    places = np.array([[0.0, 0.0], [4.0, 0.0], [20.0, 0.0]])
    truth = np.repeat([0, 1, 2], 30)
    spread = np.array([0.01, 0.01, 1.0])[truth, None]
    signal = (places[truth] + spread * rng.standard_normal((90, 2))).astype(np.float32)
    weights = np.ones(90)
    state = _clustering(signal, truth, weights)
    assert shift_clusters(signal, state, weights, rng=np.random.default_rng(0)) == 0
    # twin: with the others close to each other it wins more
    signal[truth == 1] -= np.float32([3.9, 0.0])
    state = _clustering(signal, truth, weights)
    assert shift_clusters(signal, state, weights, rng=np.random.default_rng(0)) == 1


def test_an_empty_cluster_and_vertices_that_are_all_the_same(rng):
    signal, truth, weights = _three_groups(rng)
    state = _clustering(signal, truth, weights)
    state.means = np.concatenate([state.means, np.zeros((1, 2), np.float32)])
    assert shift_clusters(signal, state, weights, rng=np.random.default_rng(0)) >= 1
    assert len(np.unique(state.labels)) == 4
    same = np.ones((20, 3), np.float32)
    state = _clustering(same, np.arange(20) % 4, np.ones(20))
    assert shift_clusters(same, state, np.ones(20), rng=np.random.default_rng(0)) == 0
