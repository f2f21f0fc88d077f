import numpy as np

from prtbake_workers.compress.clusters import (
    members_by_cluster,
    refill_empty_clusters,
    split_in_two,
    weighted_mean,
)


def test_members_are_all_vertices_once(rng):
    labels = rng.integers(0, 5, 40).astype(np.int32)
    labels[labels == 3] = 4
    members = members_by_cluster(labels, 6)
    assert [len(m) for m in members] == np.bincount(labels, minlength=6).tolist()
    for cluster, verts in enumerate(members):
        assert np.all(labels[verts] == cluster)
        assert np.all(np.diff(verts) > 0)


def test_split_separates_two_groups_and_refuses_one_point(rng):
    signal = np.concatenate([np.zeros((5, 4)), np.ones((3, 4))]).astype(np.float32)
    second = split_in_two(signal, np.ones(8))
    assert second is not None
    assert len(set(second[:5].tolist())) == 1
    assert second[0] != second[5]
    assert split_in_two(signal[:5], np.ones(5)) is None
    assert split_in_two(signal[:1], np.ones(1)) is None


def test_mean_of_vertices_without_weight_is_the_plain_mean(rng):
    signal = rng.standard_normal((6, 4)).astype(np.float32)
    mean = weighted_mean(signal, np.zeros(6))
    np.testing.assert_allclose(mean, signal.mean(axis=0), rtol=1e-5, atol=1e-7)


def test_the_worst_cluster_fills_the_empty_ones(rng):
    signal = rng.standard_normal((30, 4)).astype(np.float32)
    labels = np.repeat([0, 2], 15).astype(np.int32)
    errors = np.where(labels == 2, 5.0, 1.0)
    filled = refill_empty_clusters(signal, labels, errors, np.ones(30), 4)
    assert [cluster for cluster, _ in filled] == [1, 3]
    assert filled[0][1] == 2
    assert np.all(np.bincount(labels, minlength=4) > 0)
    assert np.all(labels[:15] == 0)


def test_weights_say_which_cluster_is_the_worst(rng):
    signal = rng.standard_normal((30, 4)).astype(np.float32)
    labels = np.repeat([0, 2], 15).astype(np.int32)
    errors = np.where(labels == 2, 5.0, 1.0)
    weights = np.where(labels == 2, 0.1, 1.0)
    assert refill_empty_clusters(signal, labels, errors, weights, 3) == [(1, 0)]


def test_identical_vertices_are_passed_over_and_no_error_needs_no_cluster(rng):
    signal = rng.standard_normal((30, 4)).astype(np.float32)
    signal[15:] = signal[15]
    labels = np.repeat([0, 2], 15).astype(np.int32)
    errors = np.where(labels == 2, 5.0, 1.0)
    assert refill_empty_clusters(signal, labels.copy(), errors, np.ones(30), 3) == [(1, 0)]
    assert refill_empty_clusters(signal, labels, np.zeros(30), np.ones(30), 3) == []
