from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.decode.overdraw import average_overdraw
from prtbake_storage.errors import SettingsError
from prtbake_workers.compress import less_overdraw
from prtbake_workers.compress.cpca import compress_cpca
from prtbake_workers.compress.cta import CtaRanks, compress_cta
from prtbake_workers.compress.less_overdraw import less_overdraw_cpca, less_overdraw_cta
from support.grid_mesh import sphere_faces
from synthetic_transfer import equal_area_directions


@pytest.fixture(scope="module")
def faces(diffuse):
    return sphere_faces(equal_area_directions(len(diffuse)))


@pytest.fixture(scope="module")
def areas(diffuse):
    return 0.5 + np.random.default_rng(5).random(len(diffuse))


@pytest.fixture(scope="module")
def cpca(diffuse, areas):
    return compress_cpca(diffuse, 20, 3, seed=1, vertex_weights=areas)


@pytest.fixture(scope="module")
def cta(coloured, areas):
    return compress_cta(
        coloured, 12, CtaRanks(5, 12, 6), seed=1, vertex_weights=areas, n_channels=3
    )


def _squared_error(model, data, areas):
    gap = (model.reconstruct().astype(float) - data).reshape(len(data), -1)
    return float(areas @ np.sum(gap**2, axis=1))


@pytest.mark.parametrize("budget", [0.0, 0.05, 0.3])
def test_a_clustered_pca_stays_within_the_budget(cpca, diffuse, faces, areas, budget):
    less = less_overdraw_cpca(cpca, diffuse, faces, budget=budget, vertex_weights=areas)
    error, before = (_squared_error(model, diffuse, areas) for model in (less, cpca))
    # float32 factors, sums in float64
    assert error <= (1.0 + budget) * before * (1.0 + 1e-5)
    assert less.objective[-1] == pytest.approx(error, rel=1e-5)
    assert less.squared_error_ratio == pytest.approx(error / cpca.initial_energy, rel=1e-5)
    assert average_overdraw(faces, less.labels) < average_overdraw(faces, cpca.labels)
    assert np.all(less.ranks <= cpca.ranks)
    assert len(np.unique(less.labels)) == cpca.n_clusters


def test_more_budget_is_less_overdraw_and_more_error(diffuse, faces, areas, rng):
    size = np.sqrt(np.mean(diffuse.astype(float) ** 2))
    noisy = (diffuse + 0.5 * size * rng.standard_normal(diffuse.shape)).astype(np.float32)
    model = compress_cpca(noisy, 20, 3, seed=1, vertex_weights=areas)
    little, much = (
        less_overdraw_cpca(model, noisy, faces, budget=budget, vertex_weights=areas)
        for budget in (0.0, 0.05)
    )
    assert average_overdraw(faces, much.labels) < average_overdraw(faces, little.labels)
    assert _squared_error(much, noisy, areas) > _squared_error(little, noisy, areas)


def test_a_fit_after_the_moves_wins_error_back(cpca, diffuse, faces, areas):
    once = less_overdraw_cpca(cpca, diffuse, faces, budget=0.05, vertex_weights=areas, rounds=1)
    again = less_overdraw_cpca(cpca, diffuse, faces, budget=0.05, vertex_weights=areas)
    assert average_overdraw(faces, again.labels) <= average_overdraw(faces, once.labels)
    for cluster in range(once.n_clusters):
        members = once.labels == cluster
        mean = np.average(diffuse[members].astype(float), axis=0, weights=areas[members])
        np.testing.assert_allclose(once.means[cluster], mean, rtol=1e-4, atol=1e-6)
    moved = once.labels != cpca.labels
    assert moved.any()
    cluster = int(once.labels[moved][0])
    assert not np.allclose(once.means[cluster], cpca.means[cluster], rtol=1e-4, atol=1e-6)


def test_vertices_settle_where_neither_error_nor_draws_rise(
    cpca, diffuse, faces, areas, monkeypatch
):
    options = {"budget": 0.0, "vertex_weights": areas, "rounds": 1}
    settled = less_overdraw_cpca(cpca, diffuse, faces, **options)
    monkeypatch.setattr(less_overdraw, "MOST_SETTLING_ROUNDS", 0)
    spent = less_overdraw_cpca(cpca, diffuse, faces, **options)
    assert average_overdraw(faces, settled.labels) <= average_overdraw(faces, spent.labels)
    error, before = (_squared_error(one, diffuse, areas) for one in (settled, spent))
    assert error < (1.0 - less_overdraw.SETTLED) * before
    # by hand, in the bases as they are: free moves that are left would win next to nothing
    left, there_were = (_free_wins(one, diffuse, faces, areas) for one in (settled, spent))
    assert left < less_overdraw.SETTLED * error < there_were


def _free_wins(model, data, faces, areas):
    """What vertices would win, each alone, in a cluster of their triangles at no more draws."""
    x = data.astype(float)
    errors = np.empty((len(x), model.n_clusters))
    for cluster in range(model.n_clusters):
        centred = x - model.means[cluster]
        along = centred @ model.components[cluster].astype(float).T
        errors[:, cluster] = np.sum(centred**2, axis=1) - np.sum(along**2, axis=1)
    won = 0.0
    for vert in range(len(x)):
        own = faces[(faces == vert).any(axis=1)]
        draws = average_overdraw(own, model.labels)
        for cluster in set(model.labels[own].ravel().tolist()) - {int(model.labels[vert])}:
            moved = model.labels.copy()
            moved[vert] = cluster
            less = errors[vert, model.labels[vert]] - errors[vert, cluster]
            if less > 0.0 and average_overdraw(own, moved) <= draws:
                won += areas[vert] * less
    return won


@pytest.mark.parametrize("budget", [0.0, 0.1])
def test_a_tensor_model_stays_within_the_budget(cta, coloured, faces, areas, budget):
    less = less_overdraw_cta(cta, coloured, faces, budget=budget, vertex_weights=areas)
    error, before = (_squared_error(model, coloured, areas) for model in (less, cta))
    assert error <= (1.0 + budget) * before * (1.0 + 1e-4)
    assert less.objective[-1] == pytest.approx(error, rel=1e-4)
    overdraw = [average_overdraw(faces, model.labels) for model in (less, cta)]
    assert overdraw[0] <= overdraw[1]
    assert (overdraw[0] < overdraw[1]) or budget == 0.0
    # weights of a vertex that stays under the moved labels are of no use
    wrong = _squared_error_of_moved_labels(cta, less, coloured, areas)
    assert wrong > error or np.array_equal(less.labels, cta.labels)


def _squared_error_of_moved_labels(before, after, data, areas):
    return _squared_error(replace(before, labels=after.labels), data, areas)


def test_same_input_same_bytes(cpca, diffuse, faces):
    first, again = (less_overdraw_cpca(cpca, diffuse, faces, budget=0.05) for _ in range(2))
    assert first.labels.tobytes() == again.labels.tobytes()
    assert first.components.tobytes() == again.components.tobytes()


@pytest.mark.parametrize("budget", [-0.1, np.nan])
def test_a_budget_is_at_least_zero(cpca, cta, diffuse, coloured, faces, budget):
    with pytest.raises(SettingsError, match="overdraw_budget"):
        less_overdraw_cpca(cpca, diffuse, faces, budget=budget)
    with pytest.raises(SettingsError, match="overdraw_budget"):
        less_overdraw_cta(cta, coloured, faces, budget=budget)


def test_a_signal_of_another_model_is_refused(cpca, diffuse, faces):
    with pytest.raises(SettingsError, match="signal has 599 vertices, the model 600"):
        less_overdraw_cpca(cpca, diffuse[1:], faces)


@pytest.mark.parametrize("lit", [300, 0], ids=["half black", "black"])
def test_black_vertices_of_a_tensor_model_have_clusters_without_columns(coloured, faces, lit):
    rows = coloured.copy()
    rows[lit:] = 0.0
    model = compress_cta(rows, 8, CtaRanks(5, 12, 6), seed=1, n_channels=3)
    assert lit or not model.ranks[:, 1:].any()
    less = less_overdraw_cta(model, rows, faces, budget=0.05)
    assert less.squared_error_ratio <= 1.05 * model.squared_error_ratio + 1e-12
