"""Means brought up to date are those summed anew, whatever moved in between."""

import tracemalloc

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from prtbake_workers.compress import moving_means
from prtbake_workers.compress.energy import row_energy
from prtbake_workers.compress.moving_means import MovingMeans, weighted_sum
from prtbake_workers.compress.parallel import same_bytes_on_any_threads


def _oracle(signal, labels, weights, n_clusters):
    means = np.zeros((n_clusters, signal.shape[1]))
    for cluster in range(n_clusters):
        own = labels == cluster
        if own.any():
            share = weights[own] if weights[own].any() else np.ones(own.sum())
            means[cluster] = np.average(signal[own].astype(float), axis=0, weights=share)
    return means


def _moving(signal, weights, n_clusters):
    means = np.zeros((n_clusters, signal.shape[1]), np.float32)
    return MovingMeans(signal, weights, row_energy(signal), n_clusters), means


@pytest.mark.parametrize("weighted", [False, True])
def test_means_and_distances_follow_the_members(rng, weighted):
    signal = (rng.standard_normal((600, 37)) + 2.0).astype(np.float32)
    weights = rng.random(600) if weighted else np.ones(600)
    moving, means = _moving(signal, weights, 11)
    labels = rng.integers(0, 11, 600).astype(np.int32)
    distances = np.full(600, np.inf)
    for share in (1.0, 0.3, 0.05, 0.01, 0.0):
        movers = rng.random(600) < share
        labels[movers] = rng.integers(0, 11, movers.sum())
        moving.update(labels, means)
        moving.measure(labels, means, distances)
        expected = _oracle(signal, labels, weights, 11)
        # float64 sums, rounded once to float32
        np.testing.assert_allclose(means, expected, rtol=1.3e-7, atol=1e-12)
        exact = np.sum((signal.astype(float) - means[labels]) ** 2, axis=1)
        np.testing.assert_allclose(distances, exact, rtol=1e-6)
        # float32 differences of those who moved
        np.testing.assert_allclose(moving.distortion, weights @ exact, rtol=1e-6)
    assert not np.allclose(means, _oracle(signal, np.roll(labels, 1), weights, 11), rtol=1e-3)


def test_a_huge_row_that_leaves_takes_no_digits_along(rng):
    """1e12 beside 1e-6: float64 leaves nothing of the others when it is taken away."""
    signal = (1e-6 * rng.standard_normal((100, 5))).astype(np.float32)
    signal[0] = 1e12
    moving, means = _moving(signal, np.ones(100), 2)
    labels = np.zeros(100, np.int32)
    moving.update(labels, means)
    labels[0] = 1
    moving.update(labels, means)
    np.testing.assert_allclose(means[0], signal[1:].mean(axis=0, dtype=float), rtol=1e-6)
    plain = weighted_sum(signal, np.ones(100)) - signal[0].astype(float)
    assert not plain.any()
    # nor of what the others are from their mean
    exact = np.sum((signal[1:].astype(float) - means[0]) ** 2)
    np.testing.assert_allclose(moving.distortion, exact, rtol=1e-6)


def test_members_that_are_the_same_are_at_their_mean(rng):
    row = rng.standard_normal(300).astype(np.float32)
    signal = np.concatenate([np.tile(row, (50, 1)), rng.standard_normal((50, 300), np.float32)])
    moving, means = _moving(signal, rng.random(100) + 0.1, 2)
    labels, distances = np.zeros(100, np.int32), np.full(100, np.inf)
    moving.update(labels, means)
    labels[80:] = 1
    moving.update(labels, means)
    labels[50:] = 1
    moving.update(labels, means)
    moving.measure(labels, means, distances)
    assert means[0].tobytes() == row.tobytes()
    np.testing.assert_array_equal(distances[:50], 0.0)
    assert np.all(distances[50:] > 0.0)


def test_empty_clusters_and_those_of_no_weight(rng):
    signal = rng.standard_normal((20, 4)).astype(np.float32)
    weights = np.where(np.arange(20) < 10, 1.0, 0.0)
    moving, means = _moving(signal, weights, 3)
    labels = np.repeat(np.array([0, 1], np.int32), 10)
    moving.update(labels, means)
    np.testing.assert_allclose(means, _oracle(signal, labels, weights, 3), rtol=1e-6)
    assert not means[2].any()
    labels[10:] = 2
    moving.update(labels, means)
    np.testing.assert_allclose(
        moving.distortion, np.sum((signal[:10].astype(float) - means[0]) ** 2), rtol=1e-6
    )
    assert not means[1].any()
    np.testing.assert_allclose(means[2], signal[10:].mean(axis=0), rtol=1e-5, atol=1e-7)


def test_a_mean_that_somebody_else_set_is_set_right(rng):
    signal = rng.standard_normal((40, 6)).astype(np.float32)
    moving, means = _moving(signal, np.ones(40), 2)
    labels, distances = np.repeat(np.array([0, 1], np.int32), 20), np.full(40, np.inf)
    moving.update(labels, means)
    moving.measure(labels, means, distances)
    expected, measured, distortion = means.copy(), distances.copy(), moving.distortion
    means += 1.0
    moving.measure(labels, means, distances)
    assert np.all(distances != measured)
    moving.update(labels, means)
    moving.measure(labels, means, distances)
    np.testing.assert_array_equal(means, expected)
    np.testing.assert_array_equal(distances, measured)
    assert moving.distortion == pytest.approx(distortion, rel=1e-12)


def test_a_distortion_that_falls_a_millionfold_keeps_its_digits(rng):
    """What is left is a difference of float32 numbers a million times as large."""
    signal = (1e-3 * rng.standard_normal((200, 30)) + 1.0).astype(np.float32)
    signal[:20] += rng.standard_normal((20, 30)).astype(np.float32)
    moving, means = _moving(signal, np.ones(200), 2)
    labels = np.zeros(200, np.int32)
    moving.update(labels, means)
    for n_left in range(1, 21):
        labels[:n_left] = 1
        moving.update(labels, means)
    exact = sum(np.sum((signal[labels == c].astype(float) - means[c]) ** 2) for c in range(2))
    np.testing.assert_allclose(moving.distortion, exact, rtol=1e-6)
    alone = np.sum((signal[20:].astype(float) - means[0]) ** 2)
    np.testing.assert_allclose(moving._distortions[0], alone, rtol=1e-5)


def _scattered(rng, monkeypatch, n_clusters=100):
    """400 long rows, a cluster every four, in chunks of ten and pieces of two."""
    signal = rng.standard_normal((400, 2000)).astype(np.float32)
    monkeypatch.setattr(moving_means, "CHUNK_BYTES", 10 * signal[0].nbytes)
    monkeypatch.setattr(moving_means, "PIECE_BYTES", 2 * signal[0].nbytes)
    moving, means = _moving(signal, np.ones(400), n_clusters)
    labels = (np.arange(400) % n_clusters).astype(np.int32)
    moving.update(labels, means)
    labels[::4] = (labels[::4] + 7) % n_clusters
    return signal, moving, labels, means


@pytest.mark.parametrize("threads", [1, 2])
def test_followers_cost_what_moved_whatever_the_number_of_clusters(rng, monkeypatch, threads):
    """Sums of all hundred clusters in float64 would be twenty chunks, a piece or chunk each."""
    _, moving, labels, _ = _scattered(rng, monkeypatch)
    verts = np.arange(0, 400, 4)
    with threadpool_limits(limits=threads, user_api="blas"), same_bytes_on_any_threads():
        tracemalloc.start()
        moving._follow(verts, 1.0, labels[verts])
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    # a chunk's sums in float64 are two chunks, one more a thread, twice while they are added
    assert peak < (6 + 4 * threads) * moving_means.CHUNK_BYTES


def test_many_threads_follow_as_one_does(rng, monkeypatch):
    found = []
    for threads in (1, 2):
        signal, moving, labels, means = _scattered(np.random.default_rng(3), monkeypatch)
        with threadpool_limits(limits=threads, user_api="blas"), same_bytes_on_any_threads():
            moving.update(labels, means)
        found.append((moving._sums.tobytes(), moving.distortion))
        expected = _oracle(signal, labels, np.ones(400), 100)
        # float64 sums, rounded once to float32
        np.testing.assert_allclose(means, expected, rtol=1.3e-7, atol=1e-12)
    assert found[0] == found[1]
