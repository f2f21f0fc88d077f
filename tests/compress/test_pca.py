import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.pca import compress_pca


@pytest.mark.parametrize("n_components", [1, 5, 30])
def test_the_error_is_that_of_the_svd_about_the_mean(diffuse, n_components):
    model = compress_pca(diffuse, n_components, seed=0)
    x = diffuse.astype(float)
    singular = np.linalg.svd(x - x.mean(axis=0))[1]
    oracle = np.sum(singular[n_components:] ** 2)
    # float32 residuals of a small rest cost 1e-7 of the whole
    assert model.objective[-1] == pytest.approx(oracle, rel=1e-4)
    assert np.sum((x - model.reconstruct()) ** 2) == pytest.approx(oracle, rel=1e-4)
    about_zero = np.sum(np.linalg.svd(x)[1][n_components:] ** 2)
    assert model.objective[-1] != pytest.approx(about_zero, rel=1e-4)


def test_weights_serve_the_large_vertices(diffuse):
    weights = np.where(np.arange(len(diffuse)) < 300, 50.0, 1.0)
    model = compress_pca(diffuse, 3, seed=0, vertex_weights=weights)
    x, root = diffuse.astype(float), np.sqrt(weights)[:, None]
    centred = x - np.average(x, axis=0, weights=weights)
    oracle = np.sum(np.linalg.svd(root * centred)[1][3:] ** 2)
    assert model.objective[-1] == pytest.approx(oracle, rel=1e-4)
    plain = compress_pca(diffuse, 3, seed=0)
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
