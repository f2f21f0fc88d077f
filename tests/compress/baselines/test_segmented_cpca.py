"""All-frequency CPCA: exact when nothing is cut, as its slow twins when something is."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.baselines.segmented_cpca import (
    block_segments,
    compress_all_frequency_cpca,
    cut,
    even_components,
    spend_numbers,
)

N_TEXELS = 96
SEGMENTS = block_segments(4, 4)
"""One a face."""


def compressed(transfer, n_clusters, n_components, **options):
    return compress_all_frequency_cpca(
        cut(transfer, SEGMENTS), SEGMENTS, n_clusters, n_components, seed=0, **options
    )


def squared_error(model, transfer, weights):
    difference = transfer.astype(float) - model.reconstruct()
    return float(weights @ np.einsum("vkt,vkt->v", difference, difference))


def test_blocks_are_squares_of_one_face_and_cover_every_texel_once():
    texels = np.arange(N_TEXELS).reshape(6, 4, 4)
    blocks = block_segments(4, 2)
    assert len(blocks) == 24
    np.testing.assert_array_equal(np.sort(np.concatenate(blocks)), np.arange(N_TEXELS))
    np.testing.assert_array_equal(blocks[0], texels[0, :2, :2].ravel())
    np.testing.assert_array_equal(blocks[3], texels[0, 2:, 2:].ravel())
    np.testing.assert_array_equal(blocks[5], texels[1, :2, 2:].ravel())
    assert [len(s) for s in block_segments(32, 16)] == [256] * 24
    with pytest.raises(SettingsError, match="3 does not divide"):
        block_segments(4, 3)


def test_as_many_components_as_a_segment_has_dimensions_leave_nothing(sampled):
    model = compressed(sampled, 1, 64)
    # float32 factors of unit size: 1e-7 of the amplitude, 1e-14 of the energy, a few times over
    assert model.squared_error_ratio < 1e-12
    np.testing.assert_allclose(model.reconstruct(), sampled, rtol=0, atol=2e-5)
    one_less = compressed(sampled, 1, 63)
    assert one_less.squared_error_ratio > 1e-7


def test_one_cluster_is_the_svd_of_each_segment(sampled):
    """The slow twin: a full SVD a segment, in float64, weighted by area."""
    weights = np.linspace(0.5, 2.0, len(sampled))
    model = compressed(sampled, 1, 3, vertex_weights=weights)
    error = 0.0
    for texels in SEGMENTS:
        rows = sampled[:, :, texels].reshape(len(sampled), -1).astype(float)
        rows -= weights @ rows / weights.sum()
        values = np.linalg.svd(np.sqrt(weights)[:, None] * rows, compute_uv=False)
        error += np.sum(values[3:] ** 2)
    # float32 means and bases: 1e-7 of the energy, of which this is a thousandth
    assert model.objective[-1] == pytest.approx(error, rel=1e-3)
    assert compressed(sampled, 1, 3).objective[-1] != pytest.approx(error, rel=1e-3)


def test_objective_is_the_error_of_what_is_reconstructed(sampled):
    weights = np.linspace(0.5, 2.0, len(sampled))
    view_basis = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 3)))[0]
    model = compressed(
        sampled, 3, 2, vertex_weights=weights, view_basis=view_basis.astype(np.float32)
    )
    error = squared_error(model, sampled, weights)
    assert model.objective[-1] == pytest.approx(error, rel=1e-5)
    energy = float(weights @ np.einsum("vkt,vkt->v", sampled, sampled, dtype=float))
    assert model.squared_error_ratio == pytest.approx(error / energy, rel=1e-5)
    # the negative twin: segments put together in another order
    shuffled = np.roll(model.reconstruct(), 16, axis=2)
    assert np.sum((sampled - shuffled) ** 2) > 2.0 * np.sum((sampled - model.reconstruct()) ** 2)
    np.testing.assert_array_equal(model.reconstruct(slice(7, 11)), model.reconstruct()[7:11])
    # of a dark segment the mean of one cluster is left
    numbers = 4 * 3 + 4 * (80 * 2 + 3 * (2 + 1) * 3 * 16) + 2 * 3 * 16
    assert model.nbytes == 4 * numbers


def component_numbers(model, column_numbers=0.0):
    """Numbers of components and weights, counted where they are not zero."""
    used = 0.0
    for one in model.models:
        for cluster, rank in enumerate(one.ranks):
            assert not one.components[cluster, rank:].any()
            n_verts = np.count_nonzero(one.labels == cluster)
            used += rank * (n_verts + one.components.shape[2] + column_numbers)
    return used


def test_components_go_to_the_clusters_that_see_light(sampled):
    weights = np.linspace(0.5, 2.0, len(sampled))
    rich = compressed(sampled, 3, 8, vertex_weights=weights)
    budget = 3000.0
    spent = spend_numbers(rich, budget, column_numbers=5.0, vertex_weights=weights)
    used = component_numbers(spent, 5.0)
    # a component of a cluster is some 100 numbers
    assert budget - 150.0 < used <= budget
    # the last two faces are dark
    assert [int(one.ranks.sum()) for one in spent.models[4:]] == [0, 0]
    error = squared_error(spent, sampled, weights)
    assert spent.objective[-1] == pytest.approx(error, rel=1e-5)
    even = even_components(rich, budget, column_numbers=5.0, vertex_weights=weights)
    assert component_numbers(even, 5.0) <= budget
    assert even.objective[-1] == pytest.approx(squared_error(even, sampled, weights), rel=1e-5)
    assert spent.objective[-1] < 0.9 * even.objective[-1]
    # twin: no exchange of one cluster's last component for another's next, in no more numbers, wins
    ranks = [one.ranks.copy() for one in spent.models]
    lost, won = [], []
    for one, kept in zip(rich.models, ranks, strict=True):
        for cluster, rank in enumerate(kept):
            own = one.labels == cluster
            energies = weights[own] @ one.weights[own].astype(float) ** 2
            cost = np.count_nonzero(own) + one.components.shape[2] + 5.0
            if rank > 0:
                lost.append((energies[rank - 1], cost))
            if rank < one.ranks[cluster]:
                won.append((energies[rank], cost))
    assert all(
        gain <= loss * (1 + 1e-9) for loss, saved in lost for gain, cost in won if cost <= saved
    )


def test_even_components_differ_by_one_at_most(sampled):
    rich = compressed(sampled, 3, 8)
    even = even_components(rich, 4000.0)
    counts = [int(one.ranks.max()) for one in even.models]
    lit = counts[:4]
    assert max(lit) - min(lit) <= 1
    assert max(lit) > 0
    by_energy = sorted(even.models, key=lambda one: -one.initial_energy)
    counts = [int(one.ranks.max()) for one in by_energy]
    assert counts == sorted(counts, reverse=True)
    assert spend_numbers(rich, 0.0).objective == even_components(rich, 0.0).objective


def test_a_few_leading_dimensions_serve_where_the_signal_has_few(sampled):
    """Five smooth functions and noise: eight dimensions hold all but noise."""
    whole = compressed(sampled, 3, 3)
    fewer = compressed(sampled, 3, 3, n_dims=12)
    ones = np.ones(len(sampled))
    assert fewer.objective[-1] == pytest.approx(squared_error(fewer, sampled, ones), rel=1e-5)
    assert fewer.objective[-1] < 1.3 * whole.objective[-1]
    assert fewer.nbytes == whole.nbytes
    # the negative twin: too few
    assert compressed(sampled, 3, 3, n_dims=2).objective[-1] > 1.5 * whole.objective[-1]


def test_clusters_may_differ_from_segment_to_segment(sampled):
    counts = [3] * 4 + [1] * 2
    model = compressed(sampled, counts, 2)
    assert [len(one.means) for one in model.models] == counts
    with pytest.raises(SettingsError, match="5 numbers of clusters for 6 segments"):
        compressed(sampled, counts[1:], 2)


def test_parts_that_do_not_fit_are_named(sampled):
    with pytest.raises(SettingsError, match="part 1 has the shape"):
        compress_all_frequency_cpca(
            [sampled[:, :, :16], sampled[:, :, :5]], SEGMENTS[:2], 2, 2, seed=0
        )
    with pytest.raises(SettingsError, match=r"part 1 has the shape .* for 80 vertices"):
        compress_all_frequency_cpca(
            [sampled[:, :, :16], sampled[:9, :, :16]], SEGMENTS[:2], 2, 2, seed=0
        )
    with pytest.raises(SettingsError, match="0 segments"):
        compress_all_frequency_cpca([], [], 2, 2, seed=0)


def test_a_black_tensor_has_no_error(sampled):
    assert compressed(np.zeros_like(sampled), 2, 2).squared_error_ratio == 0.0
