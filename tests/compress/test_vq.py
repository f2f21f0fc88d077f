import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.vq import METHODS, STARTS, compress_vq


def _blobs(rng, n_blobs=12, per_blob=40, n_dims=20):
    """Tight groups far from each other, one row a vertex, and the group of each."""
    centres = 5.0 * rng.standard_normal((n_blobs, n_dims))
    truth = np.repeat(np.arange(n_blobs), per_blob)
    noise = 0.1 * rng.standard_normal((len(truth), n_dims))
    return (centres[truth] + noise).astype(np.float32), truth


def _found(labels, truth):
    """Whether clusters are the groups."""
    pairs = set(zip(truth.tolist(), labels.tolist(), strict=True))
    return len(pairs) == len(set(truth.tolist())) == len(set(labels.tolist()))


def _squared_error(signal, model, weights=1.0):
    rows = model.means[model.labels].astype(float)
    return float(np.sum(weights * np.sum((signal.astype(float) - rows) ** 2, axis=1)))


every = pytest.mark.parametrize("method", METHODS)
anywhere = pytest.mark.parametrize("start", STARTS)


@every
@anywhere
def test_each_vertex_has_the_mean_of_its_cluster_and_the_nearest_of_all(diffuse, method, start):
    model = compress_vq(diffuse, 24, start=start, method=method, seed=0, max_iterations=300)
    assert model.n_clusters == 24  # none is empty, wherever the means began
    for cluster in range(24):
        members = diffuse[model.labels == cluster].astype(float)
        np.testing.assert_allclose(model.means[cluster], members.mean(axis=0), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(model.reconstruct(), model.means[model.labels])
    assert model.objective[-1] == pytest.approx(_squared_error(diffuse, model), rel=1e-5)
    distances = np.sum((diffuse[:, None].astype(float) - model.means[None]) ** 2, axis=2)
    # the clustering stops when an iteration wins less than 1e-4
    assert model.objective[-1] <= 1.002 * distances.min(axis=1).sum()
    # negative twin: the mean of the next cluster
    moved = model.means[(model.labels + 1) % 24]
    assert np.sum((diffuse - moved) ** 2) > 2.0 * model.objective[-1]


@every
@anywhere
@pytest.mark.parametrize(("n_clusters", "seed"), [(2, 0), (10, 1), (100, 2)])
def test_the_objective_never_rises(diffuse, method, start, n_clusters, seed):
    model = compress_vq(diffuse, n_clusters, start=start, method=method, seed=seed)
    assert model.iterations == len(model.objective)
    assert np.all(np.diff(model.objective) <= 1e-7 * model.initial_energy)
    assert model.squared_error_per_vertex.sum() == pytest.approx(model.objective[-1], rel=1e-6)


def test_shifts_leave_local_minima_where_lbg_stays(rng):
    """Two means in one group and one over two others is a minimum of LBG."""
    signal, truth = _blobs(rng)
    found = {
        method: [
            _found(compress_vq(signal, 12, method=method, seed=seed).labels, truth)
            for seed in range(8)
        ]
        for method in METHODS
    }
    assert all(found["elbg"])
    assert not all(found["lbg"])


def test_elbg_errs_less_on_transfer(diffuse):
    errors = {
        method: np.mean(
            [compress_vq(diffuse, 20, method=method, seed=seed).objective[-1] for seed in range(3)]
        )
        for method in METHODS
    }
    assert errors["elbg"] < errors["lbg"]


@every
def test_weights_move_the_means(diffuse, rng, method):
    weights = rng.random(len(diffuse)) * np.where(np.arange(len(diffuse)) % 3, 1.0, 0.0)
    model = compress_vq(diffuse, 9, method=method, seed=0, vertex_weights=weights)
    for cluster in range(model.n_clusters):
        members = model.labels == cluster
        if not weights[members].any():
            continue
        expected = np.average(diffuse[members].astype(float), axis=0, weights=weights[members])
        np.testing.assert_allclose(model.means[cluster], expected, rtol=1e-4, atol=1e-6)
    assert model.objective[-1] == pytest.approx(_squared_error(diffuse, model, weights), rel=1e-5)
    plain = compress_vq(diffuse, 9, method=method, seed=0)
    assert _squared_error(diffuse, plain, weights) > model.objective[-1]


@every
def test_threads_change_no_byte(diffuse, method):
    models = []
    for threads in (1, 3):
        with threadpool_limits(limits=threads, user_api="blas"):
            models.append(compress_vq(diffuse, 30, method=method, seed=5))
    one, three = models
    assert one.means.tobytes() == three.means.tobytes()
    assert one.labels.tobytes() == three.labels.tobytes()
    other = compress_vq(diffuse, 30, method=method, seed=6)
    assert one.means.tobytes() != other.means.tobytes()


def test_the_box_s_points_are_not_vertices_and_its_clusters_are_full(rng):
    """In many dimensions nearly every point of the box is farther from all vertices than another."""
    signal, _ = _blobs(rng, n_dims=60)
    lowest, highest = signal.min(axis=0), signal.max(axis=0)
    points = lowest + rng.random((50, 60)) * (highest - lowest)
    nearest = np.argmin(np.sum((signal[:, None] - points[None]) ** 2, axis=2), axis=1)
    assert len(np.unique(nearest)) < 25
    assert compress_vq(signal, 50, start="hyper_box", seed=0).n_clusters == 50


def test_size_is_that_of_the_means(diffuse):
    model = compress_vq(diffuse, 6, seed=0)
    assert model.nbytes == 4 * 6 * 81
    assert model.components.shape == (6, 0, 81)
    assert model.weights.shape == (600, 0)
    assert not model.ranks.any()


@every
def test_progress_never_falls(diffuse, method):
    seen = []
    compress_vq(diffuse, 6, method=method, seed=0, progress=lambda done, _: seen.append(done))
    assert (seen[0], seen[-1]) == (0.0, 1.0)
    assert np.all(np.diff(seen) >= 0.0)


@pytest.mark.parametrize("field", ["start", "method"])
def test_an_unknown_choice_is_refused_by_name(diffuse, field):
    with pytest.raises(SettingsError, match="'best' is not available") as caught:
        compress_vq(diffuse, 6, seed=0, **{field: "best"})
    assert caught.value.pointer == f"/{field}"


@every
@anywhere
def test_fewer_distinct_vertices_than_clusters(diffuse, method, start):
    three = np.repeat(diffuse[:3], 20, axis=0)
    model = compress_vq(three, 8, start=start, method=method, seed=0)
    assert model.n_clusters == 3
    assert model.squared_error_ratio < 1e-12
    assert any("5 clusters left out" in note for note in model.notes)
    cut = compress_vq(three, 99, start=start, method=method, seed=0)
    assert any("n_clusters 99 cut to 60" in note for note in cut.notes)
    zeros = compress_vq(np.zeros_like(three), 4, start=start, method=method, seed=0)
    assert (zeros.n_clusters, zeros.squared_error_ratio) == (1, 0.0)


@every
def test_one_vertex_far_from_all_others_has_a_cluster_of_its_own(diffuse, method):
    far = diffuse.copy()
    far[17] = 1e4 * far[17] + 1.0
    model = compress_vq(far, 5, method=method, seed=0)
    assert np.count_nonzero(model.labels == model.labels[17]) == 1
    assert model.squared_error_per_vertex[17] <= 1e-10 * np.sum(far[17].astype(float) ** 2)


@every
def test_magnitudes_from_1e_minus_8_to_1e8(rng, method):
    """Each of the large decades is told apart; the small ones are one point beside them."""
    signs = rng.standard_normal((17, 30, 6))
    signal = (signs * 10.0 ** np.arange(-8, 9)[:, None, None]).reshape(-1, 6).astype(np.float32)
    model = compress_vq(signal, 40, method=method, seed=0)
    assert np.all(np.isfinite(model.means))
    assert model.objective[-1] == pytest.approx(_squared_error(signal, model), rel=1e-5)
    assert model.squared_error_ratio < 0.2
    energy = np.sum(signal[:420].astype(float) ** 2)
    assert model.squared_error_per_vertex[:420].sum() <= 2.0 * energy
