"""Bounds leave out distances, never a nearer mean."""

import numpy as np
import pytest

from prtbake_workers.compress import nearest_means
from prtbake_workers.compress.energy import row_energy
from prtbake_workers.compress.nearest_means import NearestMeans, centred_means


def _start(signal, means):
    near = NearestMeans(signal, means, row_energy(signal))
    labels = np.zeros(len(signal), np.int32)
    assert near.move(labels, means) == len(signal)
    return near, labels


def _exact(signal, means):
    return np.sum((signal[:, None].astype(float) - means[None].astype(float)) ** 2, axis=2)


@pytest.mark.parametrize("constant", [0.0, 300.0])
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_everyone_is_at_its_nearest_mean_as_means_drift(rng, scale, constant):
    signal = ((rng.standard_normal((400, 20)) + constant) * scale).astype(np.float32)
    means = signal[:15].copy()
    near, labels = _start(signal, means)
    for step in (1.0, 0.3, 0.1, 0.03, 0.01, 0.003):
        means += (step * scale * rng.standard_normal(means.shape)).astype(np.float32)
        near.move(labels, means)
        exact = _exact(signal, means)
        own = exact[np.arange(len(signal)), labels]
        # a tie to float32: differences of numbers as large as the constant
        slack = 1e-5 * own + (1e-6 * scale * max(1.0, constant)) ** 2 * 20
        assert np.all(own <= exact.min(axis=1) + slack)


def test_bounds_change_nobodys_cluster(rng, monkeypatch):
    signal = (rng.standard_normal((500, 12)) + 5.0).astype(np.float32)
    means = signal[:9].copy()
    drifts = [0.5, 0.1, 0.02, 0.02, 0.0]

    def run():
        noise, own = np.random.default_rng(1), means.copy()
        near, labels = _start(signal, own)
        found = [labels.copy()]
        for step in drifts:
            own += (step * noise.standard_normal(own.shape)).astype(np.float32)
            near.move(labels, own)
            found.append(labels.copy())
        return np.array(found)

    bounded = run()
    monkeypatch.setattr(nearest_means, "MOST_BOUND_BYTES", 0)
    np.testing.assert_array_equal(bounded, run())
    assert np.any(bounded[0] != bounded[-1])


def test_vertices_that_stay_cost_no_product(rng):
    """Blobs far apart: after a small drift nobody's bounds allow another mean."""
    centres = 50.0 * rng.standard_normal((6, 8))
    signal = (np.repeat(centres, 30, axis=0) + rng.standard_normal((180, 8))).astype(np.float32)
    means = centres.astype(np.float32)
    near, labels = _start(signal, means)
    assert len(near._active(slice(0, 180), labels)) == 0
    # its own mean is far away at once: whoever is in that cluster looks again, nobody else
    means[2] += 100.0
    near._follow(labels, means)
    active = near._active(slice(0, 180), labels)
    assert set(np.flatnonzero(labels == 2)) <= set(active.tolist())
    near._gone = near._gone + 1e3
    assert len(near._active(slice(0, 180), labels)) == 180


def test_the_reach_bounds_the_distance_to_the_own_mean(rng):
    signal = (rng.standard_normal((300, 16)) + 3.0).astype(np.float32)
    means = signal[:7].copy()
    near, labels = _start(signal, means)
    for step in (0.3, 0.1, 0.03):
        means += (step * rng.standard_normal(means.shape)).astype(np.float32)
        near._follow(labels, means)
        near._labels = labels.copy()
        own = np.sqrt(_exact(signal, means)[np.arange(300), labels])
        assert np.all(own <= near._reach * (1.0 + nearest_means.BOUND_ROUNDING))
    # triangles: no wider than what the means went, there and back
    assert np.all(near._reach <= own + 2.0 * near._gone[labels] + 1e-3)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_bounds_hold_where_norms_round_as_far_as_they_may(rng, monkeypatch, sign):
    """|m|^2 = |o|^2 cancels in |m - o|^2 + 2 o.(m - o), what |m - o|^2 was rounded by does not."""
    n_dims = 600
    worst = 1.0 + sign * n_dims * nearest_means.FLOAT32_ROUNDING
    monkeypatch.setattr(nearest_means, "row_energy", lambda rows: worst * row_energy(rows))
    point = rng.standard_normal(n_dims).astype(np.float32)
    signal = 1e-3 * rng.standard_normal((40, n_dims)).astype(np.float32)
    near, labels = _start(signal, np.tile(point, (2, 1)))
    means = np.stack([-point, 1.01 * point])
    near.move(labels, means)
    assert not labels.any()
    exact = np.sqrt(_exact(signal, means))
    bounds = near._bounds.astype(float) - near._gone
    # how far the means went is of the same worst norms, and is no part of this
    slack = nearest_means.BOUND_ROUNDING * near._gone.max()
    assert np.all(bounds <= exact + slack)
    assert np.all(near._reach + slack >= exact[:, 0])
    # close to the distances, so that they leave vertices out
    np.testing.assert_allclose(bounds, exact, rtol=1e-3)


def test_a_vertex_that_others_moved_looks_again(rng):
    centres = 50.0 * rng.standard_normal((4, 8))
    signal = (np.repeat(centres, 20, axis=0) + rng.standard_normal((80, 8))).astype(np.float32)
    means = centres.astype(np.float32)
    near, labels = _start(signal, means)
    expected = labels.copy()
    labels[7] = 3
    assert near.move(labels, means) == 1
    np.testing.assert_array_equal(labels, expected)


def test_a_mean_that_jumps_onto_a_vertex_takes_it(rng):
    signal = rng.standard_normal((200, 10)).astype(np.float32)
    means = np.concatenate([signal[:4], np.full((1, 10), 100.0, np.float32)])
    near, labels = _start(signal, means)
    assert not np.any(labels == 4)
    means[4] = signal[77]
    near.move(labels, means)
    assert labels[77] == 4


def test_centred_means_give_distances_up_to_the_vertex_own(rng):
    signal = rng.standard_normal((30, 7)).astype(np.float32)
    means = rng.standard_normal((5, 7)).astype(np.float32)
    origin = means.mean(axis=0)
    about = centred_means(means, origin)
    own = np.sum((signal.astype(float) - origin) ** 2, axis=1)[:, None]
    found = own + about.constant - 2.0 * signal @ about.centred.T
    # float32 products of numbers near 1
    np.testing.assert_allclose(found, _exact(signal, means), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(about.lengths, np.linalg.norm(means - origin, axis=1), rtol=1e-6)
