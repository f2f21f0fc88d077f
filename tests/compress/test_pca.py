import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress import pca
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.pca import compress_pca


@pytest.fixture(autouse=True)
def _many_pieces(monkeypatch):
    """Pieces of a few rows or columns, as a large signal has many."""
    monkeypatch.setattr(pca, "PIECE_BYTES", 8 * 600 * 7)


@pytest.mark.parametrize("n_components", [1, 5, 30])
@pytest.mark.parametrize("n_verts", [600, 60], ids=["tall", "wide"])
def test_the_error_is_that_of_the_svd_about_the_mean(diffuse, n_components, n_verts):
    signal = diffuse[:n_verts]
    model = compress_pca(signal, n_components, seed=0)
    x = signal.astype(float)
    singular = np.linalg.svd(x - x.mean(axis=0))[1]
    oracle = np.sum(singular[n_components:] ** 2)
    # float32 residuals of a small rest cost 1e-7 of the whole
    assert model.objective[-1] == pytest.approx(oracle, rel=1e-4)
    assert np.sum((x - model.reconstruct()) ** 2) == pytest.approx(oracle, rel=1e-4)
    about_zero = np.sum(np.linalg.svd(x)[1][n_components:] ** 2)
    assert model.objective[-1] != pytest.approx(about_zero, rel=1e-4)
    (basis,) = model.components.astype(float)
    np.testing.assert_allclose(basis @ basis.T, np.eye(n_components), rtol=0, atol=1e-6)
    assert np.all(np.diff(np.sum(model.weights.astype(float) ** 2, axis=0)) <= 0.0)


@pytest.mark.parametrize("n_verts", [600, 60], ids=["tall", "wide"])
def test_weights_serve_the_large_vertices(diffuse, n_verts):
    signal = diffuse[:n_verts]
    weights = np.where(np.arange(n_verts) < n_verts // 2, 50.0, 1.0)
    model = compress_pca(signal, 3, seed=0, vertex_weights=weights)
    x, root = signal.astype(float), np.sqrt(weights)[:, None]
    centred = x - np.average(x, axis=0, weights=weights)
    oracle = np.sum(np.linalg.svd(root * centred)[1][3:] ** 2)
    assert model.objective[-1] == pytest.approx(oracle, rel=1e-4)
    plain = compress_pca(signal, 3, seed=0)
    assert weights @ plain.squared_error_per_vertex > 1.01 * oracle


def test_it_has_one_cluster_and_no_less_than_its_factors(diffuse):
    model = compress_pca(diffuse, 4, seed=0)
    assert model.n_clusters == 1
    assert not model.labels.any()
    assert model.nbytes == 4 * (81 + 4 * 81 + 600 * 4)
    assert compress_pca(diffuse, 4, seed=9).components.tobytes() == model.components.tobytes()


def test_components_are_cut_to_the_signal_and_none_is_refused(diffuse):
    model = compress_pca(diffuse[:5], 99, seed=0)
    assert model.squared_error_ratio < 1e-10
    assert any("n_components 99 cut to 5" in note for note in model.notes)
    with pytest.raises(SettingsError, match="n_components"):
        compress_pca(diffuse, 0, seed=0)


@pytest.mark.parametrize("n_verts", [600, 60], ids=["tall", "wide"])
def test_models_of_any_size_come_of_one_gram_matrix(diffuse, n_verts, monkeypatch):
    signal = diffuse[:n_verts]
    weights = np.linspace(0.5, 2.0, n_verts)
    sums = []
    whole = pca._gram
    monkeypatch.setattr(pca, "_gram", lambda *given: sums.append(1) or whole(*given))
    principal = pca.Principal(signal, weights)
    for n_components in (4, 12, 7):
        found = principal.model(n_components, seed=0)
        alone = compress_pca(signal, n_components, seed=0, vertex_weights=weights)
        assert found.components.shape == alone.components.shape
        # eigenvectors of another subset: the same to float64, and so to a float32 rounding
        for name in ("objective", "squared_error_per_vertex"):
            np.testing.assert_allclose(getattr(found, name), getattr(alone, name), rtol=1e-4)
    assert len(sums) == 1 + 3
    other = principal.model(6, seed=0)
    assert other.objective[-1] > 1.01 * found.objective[-1]


@pytest.mark.parametrize("n_verts", [600, 60], ids=["tall", "wide"])
def test_it_is_clustered_pca_with_one_cluster(diffuse, n_verts):
    signal = diffuse[:n_verts]
    one, other = compress_pca(signal, 6, seed=0), compress_cpca(signal, 1, 6, seed=0)
    # the same subspace, by sums in another order
    atol = 1e-5 * np.abs(signal).max()
    np.testing.assert_allclose(one.reconstruct(), other.reconstruct(), rtol=0, atol=atol)
    assert one.objective[0] == pytest.approx(other.objective[0], rel=1e-5)
    assert one.objective[-1] == pytest.approx(other.objective[-1], rel=1e-5)
    assert np.abs(one.reconstruct() - compress_pca(signal, 5, seed=0).reconstruct()).max() > atol


def test_threads_change_no_byte(diffuse):
    models = []
    for threads in (1, 3):
        with threadpool_limits(limits=threads, user_api="blas"):
            models.append(compress_pca(diffuse, 12, seed=0))
    one, three = models
    assert one.components.tobytes() == three.components.tobytes()
    assert one.weights.tobytes() == three.weights.tobytes()


def test_a_rank_deficient_signal_and_zeros(rng):
    factors = rng.standard_normal((50, 2)) @ rng.standard_normal((2, 20))
    model = compress_pca((3.0 + factors).astype(np.float32), 6, seed=0)
    assert model.ranks.tolist() == [2]
    assert model.squared_error_ratio < 1e-12
    zeros = compress_pca(np.zeros((9, 20), np.float32), 3, seed=0)
    assert (zeros.ranks.tolist(), zeros.squared_error_ratio) == ([0], 0.0)


def test_repeated_singular_values(rng):
    """A ball of directions: any basis of it does, and the error is what the values say."""
    rows = np.linalg.qr(rng.standard_normal((40, 12)))[0] @ np.diag([3.0] * 6 + [1.0] * 6)
    signal = rows.astype(np.float32)
    singular = np.linalg.svd(signal - signal.mean(axis=0, dtype=float))[1]
    model = compress_pca(signal, 4, seed=0)
    assert model.objective[-1] == pytest.approx(np.sum(singular[4:] ** 2), rel=1e-5)
