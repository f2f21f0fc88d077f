import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.cpca import compress_cpca


def _squared_error(model, signal, weights=1.0):
    rows = model.means[model.labels].astype(float)
    for x, label in enumerate(model.labels):
        rows[x] += model.weights[x].astype(float) @ model.components[label].astype(float)
    per_vertex = np.sum((signal.astype(float) - rows) ** 2, axis=1)
    return per_vertex, float(np.sum(weights * per_vertex))


@pytest.mark.parametrize("n_components", [1, 5, 20])
def test_one_cluster_is_the_svd_about_the_mean(diffuse, n_components):
    model = compress_cpca(diffuse, 1, n_components, seed=0)
    x = diffuse.astype(float)
    singular = np.linalg.svd(x - x.mean(axis=0))[1]
    # The leading components leave a small rest, in which float32 residuals cost 1e-7 of the whole.
    oracle = np.sum(singular[n_components:] ** 2)
    assert model.objective[-1] == pytest.approx(oracle, rel=1e-4)
    about_zero = np.sum(np.linalg.svd(x)[1][n_components:] ** 2)
    assert model.objective[-1] != pytest.approx(about_zero, rel=1e-4)


def test_each_cluster_is_the_svd_of_its_members(diffuse):
    model = compress_cpca(diffuse, 7, 3, seed=0)
    total = 0.0
    for cluster in range(7):
        members = diffuse[model.labels == cluster].astype(float)
        singular = np.linalg.svd(members - members.mean(axis=0))[1]
        total += np.sum(singular[3:] ** 2)
    assert model.objective[-1] == pytest.approx(total, rel=1e-4)


def test_objective_is_the_error_of_the_reconstruction(diffuse):
    model = compress_cpca(diffuse, 8, 4, seed=0)
    per_vertex, total = _squared_error(model, diffuse)
    assert model.objective[-1] == pytest.approx(total, rel=1e-5)
    np.testing.assert_allclose(model.squared_error_per_vertex, per_vertex, rtol=1e-3, atol=1e-10)
    assert np.sum((diffuse.astype(float) - model.reconstruct()) ** 2) == pytest.approx(
        total, rel=1e-5
    )
    np.testing.assert_allclose(model.reconstruct(slice(5, 9)), model.reconstruct()[5:9], atol=1e-6)
    assert _squared_error(model, np.roll(diffuse, 1, axis=0))[1] > 1.5 * total


@pytest.mark.parametrize(("n_clusters", "seed"), [(1, 0), (5, 1), (10, 2), (40, 3)])
def test_objective_never_rises(diffuse, n_clusters, seed):
    model = compress_cpca(diffuse, n_clusters, 2, seed=seed)
    assert model.iterations == len(model.objective) - 1
    assert np.all(np.diff(model.objective) <= 1e-7 * model.initial_energy)


def test_classification_is_by_distance_to_the_mean(diffuse):
    model = compress_cpca(diffuse, 10, 2, seed=0, max_iterations=200)
    distances = np.sum((diffuse[:, None].astype(float) - model.means[None]) ** 2, axis=2)
    own = distances[np.arange(len(diffuse)), model.labels]
    # The clustering stops when an iteration wins less than 1e-4.
    assert own.sum() <= 1.002 * distances.min(axis=1).sum()


def test_areas_as_weights_serve_the_large_vertices(diffuse):
    weights = np.where(np.arange(len(diffuse)) < 300, 50.0, 1.0)
    plain = compress_cpca(diffuse, 5, 3, seed=0)
    weighted = compress_cpca(diffuse, 5, 3, seed=0, vertex_weights=weights)
    _, total = _squared_error(weighted, diffuse, weights)
    assert weighted.objective[-1] == pytest.approx(total, rel=1e-5)
    assert total < 0.95 * np.sum(weights * plain.squared_error_per_vertex)


def test_three_equal_channels_are_one(diffuse):
    """One set of weights: channels in a row are one longer signal."""
    one = compress_cpca(diffuse, 6, 4, seed=3)
    three = compress_cpca(np.tile(diffuse, (1, 3)), 6, 4, seed=3)
    assert three.components.shape == (6, 4, 3 * diffuse.shape[1])
    np.testing.assert_array_equal(three.labels, one.labels)
    # the same sums three times over; what rounds otherwise is amplified by the gaps of the spectra
    expected = one.reconstruct()
    atol = 1e-5 * np.abs(expected).max()
    for rows in np.split(three.reconstruct(), 3, axis=1):
        np.testing.assert_allclose(rows, expected, rtol=0, atol=atol)
    assert three.objective == pytest.approx([3.0 * value for value in one.objective], rel=1e-4)


def test_progress_rises_to_one_with_every_iteration(diffuse):
    seen = []
    model = compress_cpca(diffuse, 6, 3, seed=0, progress=lambda f, state: seen.append((f, state)))
    fractions = [fraction for fraction, _ in seen]
    assert fractions[0] == 0.0
    assert fractions[-1] == 1.0
    assert np.all(np.diff(fractions) > 0)
    # the start, each clustering iteration, the end
    assert len(seen) == model.iterations + 2
    assert seen[-1][1] == f"error {model.objective[-1] / model.initial_energy:.3%}"


def test_same_seed_same_bytes(diffuse):
    first, again = (compress_cpca(diffuse, 6, 4, seed=3) for _ in range(2))
    for name in ("means", "components", "weights", "labels"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()


def test_size_is_that_of_the_float32_factors(diffuse):
    model = compress_cpca(diffuse, 6, 4, seed=0)
    assert model.nbytes == 4 * (6 * 81 + 6 * 4 * 81 + 600 * 4)


@pytest.mark.parametrize(("field", "value"), [("method", "best"), ("back_end", "qr")])
def test_unknown_choices_are_refused_by_name(diffuse, field, value):
    with pytest.raises(SettingsError, match=value) as caught:
        compress_cpca(diffuse, 6, 4, seed=0, **{field: value})
    assert caught.value.pointer == f"/{field}"
