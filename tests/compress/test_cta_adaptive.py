"""Tensors with ranks of their own: never more numbers nor more error, measured independently."""

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.cta import CtaRanks, compress_cta
from prtbake_workers.compress.cta_adaptive import with_own_ranks


def measured(transfer, model, weights):
    """Weighted squared error of the reconstruction itself."""
    difference = model.reconstruct().astype(float) - transfer
    return float(weights @ np.einsum("vkl,vkl->v", difference, difference))


def numbers(model):
    """Numbers of the factors, counted entry by entry: those that only pad are zeros."""
    used = sum(
        np.count_nonzero(getattr(model, name)) for name in ("light_bases", "dual_bases", "weights")
    )
    return used + model.view_basis.size


@pytest.fixture(scope="module")
def weights():
    return np.random.default_rng(3).uniform(0.5, 2.0, 600)


@pytest.fixture(scope="module", params=[1, 3])
def case(request, glossy, coloured, weights):
    transfer = glossy if request.param == 1 else coloured
    even = compress_cta(
        transfer, 12, CtaRanks(6, 16, 10), seed=1, max_iterations=4, vertex_weights=weights,
        n_channels=request.param,
    )  # fmt: skip
    return transfer, even, with_own_ranks(even, transfer, vertex_weights=weights)


def test_less_error_in_no_more_numbers(case, weights):
    transfer, even, own = case
    assert own.nbytes <= even.nbytes
    assert 4 * numbers(own) <= even.nbytes
    error = measured(transfer, own, weights)
    # float32 factors, against errors of 1e-3 of the signal
    assert error == pytest.approx(own.objective[-1], rel=1e-3)
    assert error < 0.9 * measured(transfer, even, weights)
    assert weights @ own.squared_error_per_vertex == pytest.approx(own.objective[-1], rel=1e-9)


def test_bases_stay_orthonormal_and_zero_beyond_the_ranks(case):
    _, even, own = case
    n_rows, width = own.n_channels * own.view_basis.shape[1], own.light_bases.shape[2]
    np.testing.assert_array_equal(own.view_basis, even.view_basis)
    assert own.ranks[:, 0].max() <= even.view_basis.shape[1]
    assert (own.ranks.max(axis=0)[1:] == (width, own.dual_bases.shape[1])).all()
    assert len(np.unique(own.ranks, axis=0)) > 3
    for light, dual, (view, r_light, r_vert) in zip(
        own.light_bases, own.dual_bases, own.ranks, strict=True
    ):
        gram = light.T.astype(float) @ light
        np.testing.assert_allclose(gram, np.diag(np.arange(width) < r_light), atol=1e-5)
        gram = dual.astype(float) @ dual.T
        np.testing.assert_allclose(gram, np.diag(np.arange(len(dual)) < r_vert), atol=1e-5)
        rows = dual.reshape(len(dual), own.n_channels, n_rows // own.n_channels, width)
        assert not rows[:, :, view:].any()
        assert not rows[:, :, :, r_light:].any()


def test_the_error_after_the_allocation_joins_the_trace(case):
    _, even, own = case
    assert own.objective[:-1] == even.objective
    assert own.objective[-1] < even.objective[-1]
    np.testing.assert_array_equal(own.labels, even.labels)


def test_the_same_bytes_on_any_threads(case, weights):
    transfer, even, own = case
    with threadpool_limits(limits=2, user_api="blas"):
        again = with_own_ranks(even, transfer, vertex_weights=weights)
    for name in ("labels", "ranks", "weights", "light_bases", "dual_bases"):
        np.testing.assert_array_equal(getattr(again, name), getattr(own, name))


def block(rng, n_verts, ranks, coeffs, fall):
    """(verts, 9, 81) of true (view, light, vert) ranks, in some coefficients, with falling strength."""
    view, light, vert = ranks
    u_view = np.linalg.qr(rng.standard_normal((9, view)))[0]
    u_light = np.zeros((81, light))
    u_light[coeffs] = np.linalg.qr(rng.standard_normal((len(coeffs), light)))[0]
    core = rng.standard_normal((vert, view, light)) * fall ** np.arange(vert)[:, None, None]
    # all about alike: clusters have means far from each other
    mixed = np.tensordot(rng.uniform(0.8, 1.2, (n_verts, vert)), core, 1)
    return (u_view @ mixed @ u_light.T).astype(np.float32)


@pytest.fixture(scope="module")
def uneven():
    """A block of few strong vectors, one of rank (4, 10, 8), and vertices without any light."""
    rng = np.random.default_rng(5)
    weak = block(rng, 60, (4, 7, 6), np.arange(30), 0.02)
    strong = block(rng, 60, (4, 10, 8), np.arange(40, 81), 0.9)
    return np.concatenate([weak, strong, np.zeros((20, 9, 81), np.float32)])


def test_true_ranks_are_found_where_there_is_storage_for_them(uneven):
    even = compress_cta(uneven, 3, CtaRanks(8, 7, 6), seed=1)
    own = with_own_ranks(even, uneven)
    groups = [np.unique(own.labels[part]) for part in (slice(60), slice(60, 120), slice(120, 140))]
    assert [len(found) for found in groups] == [1, 1, 1]
    weak, strong, dark = (own.ranks[found[0]].tolist() for found in groups)
    assert strong[1:] == [10, 8]
    assert weak[2] < 6
    assert dark == [0, 0, 0]
    ones = np.ones(140)
    assert own.nbytes <= even.nbytes
    # twin: even ranks cannot hold the strong block
    assert measured(uneven, own, ones) < 0.03 * measured(uneven, even, ones)
    assert not own.reconstruct(slice(120, 140)).any()


def test_more_storage_than_there_is_rank_changes_nothing_for_the_worse(uneven):
    even = compress_cta(uneven, 3, CtaRanks(9, 40, 40), seed=1)
    own = with_own_ranks(even, uneven)
    assert own.nbytes <= even.nbytes
    ones, energy = np.ones(140), even.initial_energy
    # float32 factors: 1e-14 of the energy, a few times over
    assert measured(uneven, even, ones) < 1e-12 * energy
    assert measured(uneven, own, ones) < 1e-12 * energy


def test_black_transfer_and_clusters_without_weight():
    black = np.zeros((30, 9, 81), np.float32)
    even = compress_cta(black, 2, CtaRanks(3, 4, 5), seed=0)
    assert with_own_ranks(even, black) is even
    rng = np.random.default_rng(2)
    transfer = block(rng, 40, (4, 10, 8), np.arange(81), 0.9)
    transfer[20:] *= 3.0
    weights = np.ones(40)
    weights[:20] = 0.0
    even = compress_cta(transfer, 2, CtaRanks(4, 4, 4), seed=0, vertex_weights=weights)
    own = with_own_ranks(even, transfer, vertex_weights=weights)
    assert own.nbytes <= even.nbytes
    assert measured(transfer, own, weights) <= measured(transfer, even, weights) * (1 + 1e-6)


def test_a_tensor_of_other_vertices_is_refused(glossy, case):
    _, even, _ = case
    with pytest.raises(SettingsError, match="transfer has 599 vertices, the model 600"):
        with_own_ranks(even, glossy[:599])
