import numpy as np
import pytest
from tensorly.decomposition import partial_tucker
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.cta import CtaRanks, compress_cta

RANKS = CtaRanks(5, 12, 8)


def _squared_error(model, transfer, weights=1.0):
    """Squared error by eq. 18 of Tsai & Shih, in float64, one vertex at a time."""
    view = model.view_basis.astype(float)
    total = np.empty(len(transfer))
    for x, label in enumerate(model.labels):
        w = model.weights[x].astype(float)
        core = (model.dual_bases[label].astype(float).T @ w).reshape(view.shape[1], -1)
        approximated = view @ core @ model.light_bases[label].astype(float).T
        total[x] = np.sum((transfer[x].astype(float) - approximated) ** 2)
    return total, float(np.sum(weights * total))


@pytest.fixture(scope="module")
def model(glossy):
    return compress_cta(glossy, 6, RANKS, seed=1)


def test_one_cluster_reaches_the_error_of_partial_tucker(glossy):
    model = compress_cta(glossy, 1, RANKS, seed=0, max_iterations=30)
    (core, _), _ = partial_tucker(
        glossy.astype(float),
        rank=[RANKS.vert, RANKS.view, RANKS.light],
        modes=[0, 1, 2],
        n_iter_max=60,
        tol=1e-10,
    )
    oracle = np.sum(glossy.astype(float) ** 2) - np.sum(core**2)
    # Ours stops when an iteration wins less than 0.1 %; both are local searches.
    assert model.objective[-1] == pytest.approx(oracle, rel=3e-3)
    smaller = compress_cta(glossy, 1, RANKS._replace(light=11), seed=0, max_iterations=30)
    assert smaller.objective[-1] != pytest.approx(oracle, rel=3e-3)


def test_objective_is_the_error_of_the_reconstruction(model, glossy):
    per_vertex, total = _squared_error(model, glossy)
    # float32 residuals: 1e-7 of the signal against residuals of 1e-1 of it.
    assert model.objective[-1] == pytest.approx(total, rel=1e-5)
    np.testing.assert_allclose(model.squared_error_per_vertex, per_vertex, rtol=1e-3, atol=1e-9)
    assert model.initial_energy == pytest.approx(np.sum(glossy.astype(float) ** 2), rel=1e-6)
    difference = glossy.astype(float) - model.reconstruct()
    assert np.sum(difference**2) == pytest.approx(total, rel=1e-5)
    swapped = np.roll(model.labels, 1)
    assert np.any(swapped != model.labels)
    assert _squared_error(_with_labels(model, swapped), glossy)[1] > 1.01 * total


def _with_labels(model, labels):
    return type(model)(**{**vars(model), "labels": labels})


def test_reconstruct_of_a_slice_is_that_part(model):
    whole = model.reconstruct()
    np.testing.assert_allclose(model.reconstruct(slice(100, 130)), whole[100:130], atol=1e-6)
    assert not np.allclose(model.reconstruct(slice(101, 131)), whole[100:130], atol=1e-6)


def test_bases_are_orthonormal(model):
    view = model.view_basis
    np.testing.assert_allclose(view.T @ view, np.eye(RANKS.view), atol=1e-6)
    for (_, light, vert), basis, dual in zip(
        model.ranks, model.light_bases, model.dual_bases, strict=True
    ):
        np.testing.assert_allclose(basis[:, :light].T @ basis[:, :light], np.eye(light), atol=1e-6)
        np.testing.assert_allclose(dual[:vert] @ dual[:vert].T, np.eye(vert), atol=1e-6)


@pytest.mark.parametrize(("n_clusters", "seed"), [(1, 0), (4, 1), (9, 2), (20, 3)])
def test_objective_never_rises(glossy, n_clusters, seed):
    model = compress_cta(glossy, n_clusters, RANKS, seed=seed)
    assert len(model.objective) == model.iterations > 1
    assert np.all(np.diff(model.objective) <= 1e-7 * model.initial_energy)


def test_clustering_is_worth_it(glossy):
    errors = [compress_cta(glossy, n, RANKS, seed=0).objective[-1] for n in (1, 4, 16)]
    assert errors[0] > 1.5 * errors[1] > 2.0 * errors[2]


def test_every_vertex_is_in_the_cluster_that_approximates_it_best(glossy):
    model = compress_cta(glossy, 6, RANKS, seed=1, max_iterations=60)
    own, total = _squared_error(model, glossy)
    best = own.copy()
    view = model.view_basis.astype(float)
    z = np.einsum("kr,vkl->vrl", view, glossy.astype(float))
    left_out = np.sum(glossy.astype(float) ** 2, (1, 2)) - np.sum(z**2, (1, 2))
    for light, dual in zip(model.light_bases, model.dual_bases, strict=True):
        rows = np.einsum("vrl,ls->vrs", z, light.astype(float)).reshape(len(z), -1)
        captured = np.sum((rows @ dual.T) ** 2, axis=1)
        best = np.minimum(best, left_out + np.sum(z**2, (1, 2)) - captured)
    # The last steps move the bases after the last classification: little is left to win.
    assert best.sum() >= 0.98 * total


def test_same_seed_same_bytes_and_another_seed_another_model(model, glossy):
    again = compress_cta(glossy, 6, RANKS, seed=1)
    for name in ("view_basis", "light_bases", "dual_bases", "weights", "labels"):
        assert getattr(again, name).tobytes() == getattr(model, name).tobytes()
    assert again.objective == model.objective
    other = compress_cta(glossy, 6, RANKS, seed=2)
    assert other.labels.tobytes() != model.labels.tobytes()


def test_size_is_that_of_the_float32_factors(model):
    n_terms, n_coeffs, n_verts = 9, 81, 600
    floats = n_terms * 5 + 6 * (n_coeffs * 12 + 8 * 5 * 12) + n_verts * 8
    assert model.nbytes == 4 * floats


def test_areas_as_weights_serve_the_large_vertices(glossy):
    weights = np.where(np.arange(len(glossy)) < 300, 50.0, 1.0)
    plain = compress_cta(glossy, 4, RANKS, seed=0)
    weighted = compress_cta(glossy, 4, RANKS, seed=0, vertex_weights=weights)
    _, total = _squared_error(weighted, glossy, weights)
    assert weighted.objective[-1] == pytest.approx(total, rel=1e-5)
    assert total < 0.95 * np.sum(weights * plain.squared_error_per_vertex)
    energy = np.sum(weights * np.sum(glossy.astype(float) ** 2, axis=(1, 2)))
    assert weighted.initial_energy == pytest.approx(energy, rel=1e-6)


def _term_major(rows):
    return np.ascontiguousarray(rows.reshape(len(rows), 3, 9, -1).swapaxes(1, 2)).reshape(
        rows.shape
    )


def test_three_channels_reconstruct_as_stated(coloured):
    model = compress_cta(coloured, 6, RANKS._replace(vert=12), seed=1, n_channels=3)
    assert model.reconstruct().shape == coloured.shape
    assert model.view_basis.shape == (9, RANKS.view)
    assert model.dual_bases.shape == (6, 12, 3 * RANKS.view * RANKS.light)
    assert np.all(model.ranks[:, 0] == RANKS.view)
    assert np.all(np.diff(model.objective) <= 1e-7 * model.initial_energy)
    difference = coloured.astype(float) - model.reconstruct()
    total = np.sum(difference**2)
    # float32 residuals: 1e-7 of the signal against residuals of 1e-1 of it.
    assert model.objective[-1] == pytest.approx(total, rel=1e-5)
    per_vertex = np.sum(difference**2, axis=(1, 2))
    np.testing.assert_allclose(model.squared_error_per_vertex, per_vertex, rtol=1e-3, atol=1e-9)
    assert model.initial_energy == pytest.approx(np.sum(coloured.astype(float) ** 2), rel=1e-6)
    for dual in model.dual_bases:
        np.testing.assert_allclose(dual @ dual.T, np.eye(12), atol=1e-6)
    # negative twin: the rows read term by term
    assert np.sum((_term_major(coloured) - model.reconstruct()) ** 2) > 10.0 * total


def test_one_cluster_of_three_channels_reaches_partial_tucker_of_their_projection(coloured):
    """With all view vectors kept only two modes are reduced: vertices, and the light."""
    ranks = CtaRanks(9, 12, 8)
    model = compress_cta(coloured, 1, ranks, seed=0, max_iterations=30, n_channels=3)
    (core, _), _ = partial_tucker(
        coloured.astype(float), rank=[8, 12], modes=[0, 2], n_iter_max=60, tol=1e-10
    )
    oracle = np.sum(coloured.astype(float) ** 2) - np.sum(core**2)
    # Ours stops when an iteration wins less than 0.1 %; both are local searches.
    assert model.objective[-1] == pytest.approx(oracle, rel=3e-3)
    smaller = compress_cta(
        coloured, 1, ranks._replace(vert=7), seed=0, max_iterations=30, n_channels=3
    )
    assert smaller.objective[-1] != pytest.approx(oracle, rel=3e-3)


def test_three_equal_channels_are_one(model, glossy):
    three = compress_cta(np.tile(glossy, (1, 3, 1)), 6, RANKS, seed=1, n_channels=3)
    # the same sums three times over; what rounds otherwise is amplified by the gaps of the spectra
    assert three.objective == pytest.approx([3.0 * value for value in model.objective], rel=1e-4)
    expected = model.reconstruct()
    atol = 1e-4 * np.abs(expected).max()
    for rows in np.split(three.reconstruct(), 3, axis=1):
        np.testing.assert_allclose(rows, expected, rtol=0, atol=atol)
    other = compress_cta(glossy, 6, RANKS, seed=2).reconstruct()
    assert np.abs(other - expected).max() > 100 * atol


@pytest.mark.parametrize("n_channels", [0, 2])
def test_channels_that_the_rows_do_not_hold_are_refused(glossy, n_channels):
    with pytest.raises(SettingsError, match="n_channels") as caught:
        compress_cta(glossy, 6, RANKS, seed=1, n_channels=n_channels)
    assert caught.value.pointer == "/n_channels"


def test_progress_rises_to_one(glossy):
    seen = []
    compress_cta(glossy, 3, RANKS, seed=0, progress=lambda f, state: seen.append((f, state)))
    fractions = [fraction for fraction, _ in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert "error" in seen[-1][1]


@pytest.mark.parametrize("n_clusters", [1, 6])
def test_threads_change_no_byte(glossy, n_clusters):
    """With fewer clusters than threads as well, where a product alone could be spread."""
    models = []
    for threads in (1, 2, 3):
        with threadpool_limits(limits=threads, user_api="blas"):
            models.append(compress_cta(glossy, n_clusters, RANKS, seed=1))
    for other in models[1:]:
        for name in ("view_basis", "light_bases", "dual_bases", "weights", "labels"):
            np.testing.assert_array_equal(getattr(other, name), getattr(models[0], name))
        assert other.objective == models[0].objective
