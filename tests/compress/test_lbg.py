import numpy as np
import pytest

from prtbake_workers.compress.clusters import members_by_cluster
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.lbg import lbg
from prtbake_workers.compress.monotone import FOLLOWED_SHORT, ObjectiveRose
from prtbake_workers.compress.moving_means import MovingMeans


def _run(signal, n_clusters, *, seed=0, weights=None, max_iterations=50, tolerance=0.0):
    weights = np.ones(len(signal)) if weights is None else weights
    return lbg(
        signal,
        n_clusters,
        rng=np.random.default_rng(seed),
        weights=weights,
        max_iterations=max_iterations,
        tolerance=tolerance,
    )


def _blobs(rng, n_blobs=8, per_blob=40, n_dims=20):
    centres = 5.0 * rng.standard_normal((n_blobs, n_dims))
    truth = np.repeat(np.arange(n_blobs), per_blob)
    noise = 0.1 * rng.standard_normal((len(truth), n_dims))
    return (centres[truth] + noise).astype(np.float32), truth


def _distances(signal, means):
    return np.sum((signal[:, None].astype(float) - means[None].astype(float)) ** 2, axis=2)


def test_separate_blobs_are_found(rng):
    signal, truth = _blobs(rng)
    labels = _run(signal, 8).labels
    pairs = set(zip(truth.tolist(), labels.tolist(), strict=True))
    assert len(pairs) == 8
    assert len(set(labels.tolist())) == 8


def test_at_the_end_everyone_is_nearest_to_its_own_mean(diffuse):
    result = _run(diffuse, 12)
    distances = _distances(diffuse, result.means)
    np.testing.assert_array_equal(np.argmin(distances, axis=1), result.labels)
    own = distances[np.arange(len(diffuse)), result.labels]
    # float32 differences of float32 numbers: 6e-8 of the signal, whose square is as large as these.
    np.testing.assert_allclose(result.squared_distances, own, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(result.objective[-1], own.sum(), rtol=1e-6)
    shifted = np.roll(result.labels, 1)
    assert not np.array_equal(np.argmin(distances, axis=1), shifted)


def test_objective_never_rises(diffuse):
    objective = _run(diffuse, 30).objective
    assert len(objective) > 2
    assert np.all(np.diff(objective) <= 1e-7 * np.sum(diffuse.astype(float) ** 2))


def _followed_too_low(monkeypatch, share):
    followed = MovingMeans.distortion.fget
    monkeypatch.setattr(MovingMeans, "distortion", property(lambda own: share * followed(own)))


def test_the_last_objective_is_measured(diffuse, monkeypatch):
    _followed_too_low(monkeypatch, 1.0 - 0.9 * FOLLOWED_SHORT)
    result = _run(diffuse, 30, weights=np.linspace(0.5, 2.0, len(diffuse)))
    distortion = np.linspace(0.5, 2.0, len(diffuse)) @ result.squared_distances
    assert result.objective[-1] == distortion
    assert np.all(np.diff(result.objective) <= 0.0)
    assert _run(diffuse, 30, max_iterations=0).objective == []


def test_a_distortion_followed_much_too_low_is_refused(diffuse, monkeypatch):
    energy = np.sum(diffuse.astype(float) ** 2)
    left = _run(diffuse, 30).objective[-1]
    _followed_too_low(monkeypatch, 1.0 - 2.0 * FOLLOWED_SHORT * float(energy / left))
    with pytest.raises(ObjectiveRose, match="LBG: a squared error"):
        _run(diffuse, 30)


def test_a_distortion_followed_too_low_fails_no_component_that_goes_on_from_it(rng, monkeypatch):
    """Noise, of which a component wins about (1 + 1)^2 / 200, less than what is missing.

    Both are little beside the square of the constant.
    """
    signal = 400.0 + rng.standard_normal((400, 200)).astype(np.float32)
    _followed_too_low(monkeypatch, 0.9)
    for method in ("static", "iterative"):
        objective = compress_cpca(signal, 2, 1, method=method, seed=1, max_iterations=5).objective
        assert 0.9 * objective[0] < objective[-1] < objective[0]


def test_weights_move_the_means(diffuse, rng):
    weights = rng.random(len(diffuse)) * np.where(np.arange(len(diffuse)) % 3, 1.0, 0.0)
    result = _run(diffuse, 5, weights=weights)
    for cluster, members in enumerate(members_by_cluster(result.labels, 5)):
        expected = np.average(diffuse[members].astype(float), axis=0, weights=weights[members])
        np.testing.assert_allclose(result.means[cluster], expected, rtol=1e-5, atol=1e-7)
        plain = diffuse[members].mean(axis=0)
        assert not np.allclose(result.means[cluster], plain, rtol=1e-5, atol=1e-7)


def test_same_seed_same_clusters(diffuse):
    first, again = _run(diffuse, 9, seed=4), _run(diffuse, 9, seed=4)
    np.testing.assert_array_equal(first.labels, again.labels)
    assert first.means.tobytes() == again.means.tobytes()


def test_a_large_constant_does_not_hide_the_clusters(rng):
    signal, truth = _blobs(rng)
    labels = _run(signal + np.float32(3000.0), 8).labels
    assert len(set(zip(truth.tolist(), labels.tolist(), strict=True))) == 8


def test_no_cluster_stays_empty_while_points_differ(rng):
    # Nearly all points coincide, so that seeds and updates leave clusters empty.
    signal = np.zeros((200, 3), np.float32)
    signal[:12] = rng.standard_normal((12, 3))
    result = _run(signal, 13)
    assert len(np.unique(result.labels)) == 13
    assert result.objective[-1] == pytest.approx(0.0, abs=1e-12)
