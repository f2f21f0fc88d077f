"""Signals that leave clustered PCA little to work with, by every kind and back end."""

import numpy as np
import pytest

from prtbake_workers.compress.cpca import BACK_ENDS, METHODS, compress_cpca

kinds = pytest.mark.parametrize("method", METHODS)
back_ends = pytest.mark.parametrize("back_end", BACK_ENDS)


def _compress(signal, n_clusters, n_components, **options):
    """Compress and check what must hold for any input."""
    model = compress_cpca(signal, n_clusters, n_components, seed=0, **options)
    weights = options.get("vertex_weights")
    weights = np.ones(len(signal)) if weights is None else weights
    rebuilt = model.reconstruct()
    squared = np.sum((signal.astype(float) - rebuilt) ** 2, axis=1)
    assert np.all(np.isfinite(rebuilt))
    # float32 of the reconstruction itself
    assert abs(weights @ squared - model.objective[-1]) <= 1e-6 * model.initial_energy
    assert np.all(np.diff(model.objective) <= 1e-7 * model.initial_energy)
    assert sorted(set(model.labels.tolist())) == list(range(model.n_clusters))
    n_dims = signal.shape[1]
    assert model.nbytes <= 4 * (
        model.n_clusters * (n_components + 1) * n_dims + len(signal) * n_components
    )
    return model


def _families(rng, n_verts=120, n_families=4, n_dims=30, n_spanned=4):
    """Rows of some families far apart, each of a subspace of its own."""
    centres = 10.0 * rng.standard_normal((n_families, n_dims))
    spans = rng.standard_normal((n_families, n_spanned, n_dims))
    family = np.arange(n_verts) % n_families
    places = rng.standard_normal((n_verts, n_spanned))
    return (centres[family] + np.einsum("vs,vsd->vd", places, spans[family])).astype(np.float32)


@kinds
@back_ends
def test_repeated_singular_values(rng, method, back_end):
    """Every direction of a cluster is as strong as any other: what is left is what was cut."""
    corners = np.concatenate([np.eye(12), -np.eye(12)])
    signal = np.concatenate([corners, corners + 50.0]).astype(np.float32)
    model = _compress(signal, 2, 5, method=method, back_end=back_end)
    # 24 vertices of unit length about each mean, evenly over 12 directions
    assert model.objective[-1] == pytest.approx(2 * 24 * 7 / 12, rel=1e-4)
    assert model.ranks.sum() == 10
    for components, rank in zip(model.components, model.ranks, strict=True):
        own = components[:rank]
        np.testing.assert_allclose(own @ own.T, np.eye(rank), atol=1e-6)


@kinds
@back_ends
def test_rank_deficient_clusters(rng, method, back_end):
    signal = _families(rng, n_spanned=2)
    model = _compress(signal, 4, 6, method=method, back_end=back_end)
    assert model.squared_error_ratio < 1e-12
    assert np.all(model.ranks == 2)
    noise = 0.01 * rng.standard_normal(signal.shape).astype(np.float32)
    assert _compress(signal + noise, 4, 2, method=method).squared_error_ratio > 1e-7


@kinds
def test_near_duplicate_clusters(rng, method):
    """Two families a millionth apart are one cluster's worth, and no harm comes of the other."""
    one = _families(rng, n_families=1)
    twin = one + np.float32(1e-6) * rng.standard_normal(one.shape).astype(np.float32)
    signal = np.concatenate([one, twin])
    model = _compress(signal, 6, 4, method=method)
    assert model.squared_error_ratio < 1e-11
    assert _compress(signal, 6, 2, method=method).squared_error_ratio > 1e-4


@kinds
def test_transfer_spanning_sixteen_decades(rng, method):
    scale = np.logspace(-8, 8, 120)[:, None]
    signal = (scale * _families(rng)).astype(np.float32)
    model = _compress(signal, 8, 3, method=method)
    assert 0.0 < model.squared_error_ratio < 1e-2
    # the faintest lie in one cluster, off by what is left of the largest there, not of all
    faint = model.squared_error_per_vertex[:30]
    energy = np.sum(signal.astype(float) ** 2, axis=1)
    assert np.all(faint < 1e-4 * energy[60:].mean())


@kinds
def test_one_vertex_far_from_all_others(rng, method):
    signal = _families(rng)
    without = _compress(signal, 4, 2, method=method)
    signal = np.concatenate([signal, np.full((1, 30), 1e4, np.float32)])
    model = _compress(signal, 5, 2, method=method)
    # it has a cluster of its own, and is held exactly
    assert np.sum(model.labels == model.labels[-1]) == 1
    assert model.squared_error_per_vertex[-1] == 0.0
    assert model.ranks[model.labels[-1]] == 0
    assert model.objective[-1] < 1.5 * without.objective[-1]


@kinds
@back_ends
def test_cancellation_near_a_perfect_fit(rng, method, back_end):
    """Error 1e-11 of the energy: a difference of energies in float32 would be off by 1e-7."""
    exact = _families(rng, n_families=1, n_spanned=3).astype(float)
    signal = (exact + 2e-5 * rng.standard_normal(exact.shape)).astype(np.float32)
    model = _compress(signal, 1, 3, method=method, back_end=back_end)
    centred = signal.astype(float) - signal.mean(axis=0, dtype=float)
    expected = np.sum(np.linalg.svd(centred, compute_uv=False)[3:] ** 2)
    assert 1e-12 < expected / model.initial_energy < 1e-10
    # rounding of float32 factors and differences, 1e-7 of the signal beside 2e-5
    assert model.objective[-1] == pytest.approx(expected, rel=0.01)
    deviation = signal - model.means[0]
    difference = np.sum(deviation**2) - np.sum(model.weights**2)
    assert difference != pytest.approx(expected, rel=0.5)


@kinds
@back_ends
def test_fewer_distinct_vertices_than_clusters(rng, method, back_end):
    distinct = rng.standard_normal((3, 30)).astype(np.float32)
    signal = np.repeat(distinct, 20, axis=0)
    model = _compress(signal, 8, 2, method=method, back_end=back_end)
    assert model.n_clusters == 3
    assert model.squared_error_ratio < 1e-13
    assert any("5 clusters left out" in note for note in model.notes)


@kinds
def test_weights_of_zero(rng, method):
    signal = _families(rng, n_spanned=6)
    weights = np.ones(len(signal))
    weights[::3] = 0.0
    counted = weights > 0.0
    weighted = _compress(signal, 1, 2, method=method, vertex_weights=weights)
    without = _compress(signal[counted], 1, 2, method=method)
    plain = _compress(signal, 1, 2, method=method).squared_error_per_vertex[counted].sum()
    assert weighted.objective[-1] == pytest.approx(without.objective[-1], rel=1e-5)
    assert weighted.objective[-1] != pytest.approx(plain, rel=1e-5)
    # they follow the same families
    weighted = _compress(signal, 4, 2, method=method, vertex_weights=weights)
    energy = np.sum(signal.astype(float) ** 2, axis=1)
    errors = weighted.squared_error_per_vertex[~counted]
    assert errors.sum() < 0.5 * energy[~counted].sum()


@kinds
def test_a_cluster_that_weighs_nothing(rng, method):
    """A family of no weight at all lies far off, and is held as well as it can be."""
    signal = _families(rng)
    signal[:20] += 200.0
    weights = np.ones(len(signal))
    weights[:20] = 0.0
    model = _compress(signal, 6, 3, method=method, vertex_weights=weights)
    assert np.all(np.isfinite(model.squared_error_per_vertex))
