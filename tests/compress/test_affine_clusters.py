import numpy as np
import pytest

from prtbake_workers.compress import affine_classify
from prtbake_workers.compress.affine_classify import propose_clusters
from prtbake_workers.compress.affine_clusters import (
    AffineClusters,
    AffineSubspace,
    fit_subspace,
    projected_weights,
    squared_residuals,
)
from prtbake_workers.compress.coherence import coherence_of
from prtbake_workers.compress.gram_eigh import leading_row_space


def _oracle(rows, subspace):
    """Squared distance to the subspace, in float64."""
    centred = rows.astype(float) - subspace.mean
    basis = subspace.basis.astype(float)
    return np.sum((centred - centred @ basis.T @ basis) ** 2, axis=1)


def _clusters(signal, labels, *, depth=4, weights=None):
    weights = np.ones(len(signal)) if weights is None else weights
    return AffineClusters(
        signal, weights, labels.astype(np.int32), int(labels.max()) + 1,
        depth=depth, row_space=leading_row_space,
    )  # fmt: skip


def _random_subspaces(rng, ranks, dims, offset=0.0):
    return [
        AffineSubspace(
            (offset + rng.standard_normal(dims)).astype(np.float32),
            np.linalg.qr(rng.standard_normal((dims, dims)))[0][:rank].astype(np.float32),
            np.zeros(rank),
        )
        for rank in ranks
    ]


def test_the_subspace_is_the_weighted_svd_about_the_weighted_mean(rng):
    rows = (rng.standard_normal((40, 12)) * 0.7 ** np.arange(12) + 3.0).astype(np.float32)
    weights = rng.uniform(0.1, 4.0, 40)
    subspace = fit_subspace(rows, weights, 5, leading_row_space)
    mean = weights @ rows / weights.sum()
    scaled = np.sqrt(weights)[:, None] * (rows - mean)
    _, singular, right = np.linalg.svd(scaled)
    # float32 means and components
    np.testing.assert_allclose(subspace.mean, mean, rtol=1e-6)
    np.testing.assert_allclose(subspace.gains, singular[:5] ** 2, rtol=1e-5)
    span = subspace.basis.T @ subspace.basis
    np.testing.assert_allclose(span, right[:5].T @ right[:5], atol=1e-5)
    unweighted = np.linalg.svd(rows - rows.mean(axis=0))[2][:5]
    assert not np.allclose(span, unweighted.T @ unweighted, atol=1e-5)
    rest = weights @ squared_residuals(rows, subspace)
    assert rest == pytest.approx(np.sum(singular[5:] ** 2), rel=1e-5)


def test_without_any_weight_vertices_count_alike(rng):
    rows = rng.standard_normal((20, 6)).astype(np.float32)
    none, ones = (fit_subspace(rows, w, 3, leading_row_space) for w in (np.zeros(20), np.ones(20)))
    assert none.mean.tobytes() == ones.mean.tobytes()
    assert none.basis.tobytes() == ones.basis.tobytes()


def test_residuals_near_a_perfect_fit_are_no_difference_of_energies(rng):
    """What is off by 1e-5 of the signal is 1e-10 of its energy, where float32 has seven digits."""
    (subspace,) = _random_subspaces(rng, [3], 50)
    inside = rng.standard_normal((200, 3)) @ subspace.basis + subspace.mean
    rows = (inside + 1e-5 * rng.standard_normal((200, 50))).astype(np.float32)
    expected = _oracle(rows, subspace)
    # float32 subtraction: 1e-7 of the signal beside the 1e-5, averaged over 50 dimensions
    np.testing.assert_allclose(squared_residuals(rows, subspace), expected, rtol=0.03)
    centred = rows - subspace.mean
    weights = projected_weights(rows, subspace)
    difference = np.sum(centred**2, axis=1) - np.sum(weights**2, axis=1)
    assert not np.allclose(difference, expected, rtol=0.5)


@pytest.fixture(params=["among all", "among possible"])
def either_way(request, monkeypatch):
    """Both ways of finding the cluster, whatever the sizes."""
    over = 0 if request.param == "among possible" else 10**6
    monkeypatch.setattr(affine_classify, "LEAST_DIMENSIONS_OVER", over)
    monkeypatch.setattr(affine_classify, "LEAST_CLUSTERS", 1)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("ranks", [[3] * 7, [0] * 7, [0, 5, 2, 2, 1, 5, 0]])
@pytest.mark.parametrize("offset", [0.0, 100.0])
def test_proposals_are_the_clusters_of_least_error(rng, ranks, offset):
    subspaces = _random_subspaces(rng, ranks, 20, offset)
    rows = (offset + rng.standard_normal((300, 20))).astype(np.float32)
    errors = np.column_stack([_oracle(rows, subspace) for subspace in subspaces])
    at, labels = np.arange(300), rng.integers(0, 7, 300).astype(np.int32)
    proposed = propose_clusters(rows, subspaces, labels, errors[at, labels])
    # float32 products: what is proposed is the least within their rounding
    assert np.all(errors[at, proposed] <= errors.min(axis=1) + 1e-4 * errors.max())
    to_mean = np.column_stack([np.sum((rows - s.mean) ** 2, axis=1) for s in subspaces])
    differs = np.mean(proposed != np.argmin(to_mean, axis=1))
    assert differs > 0.2 if any(ranks) else differs < 0.01


@pytest.mark.usefixtures("either_way")
def test_fees_are_charged_for_every_component(rng):
    ranks = np.array([0, 1, 4, 6])
    subspaces = _random_subspaces(rng, ranks, 12)
    rows = rng.standard_normal((200, 12)).astype(np.float32)
    fees = rng.uniform(0.0, 3.0, 200)
    errors = np.column_stack([_oracle(rows, subspace) for subspace in subspaces])
    charged = errors + fees[:, None] * ranks
    at, labels = np.arange(200), rng.integers(0, 4, 200).astype(np.int32)
    proposed = propose_clusters(rows, subspaces, labels, errors[at, labels], fees)
    assert np.mean(proposed == np.argmin(charged, axis=1)) > 0.99
    assert np.mean(proposed == np.argmin(errors, axis=1)) < 0.7


def _coherent_costs(coherence, labels, errors, unit):
    """E of [Chen2005]_ (9) and (10) of every vertex in every cluster, pair by pair."""
    apart = np.linalg.norm(coherence.positions[:, None] - coherence.positions[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    nearest = np.column_stack(
        [apart[:, labels == cluster].min(axis=1) for cluster in range(errors.shape[1])]
    )
    return np.sqrt(errors) / unit + coherence.alpha * np.minimum(nearest, 1.0)


@pytest.mark.parametrize("charged", [False, True])
def test_with_coherence_a_vertex_goes_where_it_costs_least_and_its_error_falls(rng, charged):
    ranks = np.array([2, 0, 3, 1, 2])
    subspaces = _random_subspaces(rng, ranks, 12)
    rows = rng.standard_normal((200, 12)).astype(np.float32)
    unit = np.sqrt(np.mean(np.sum(rows.astype(float) ** 2, axis=1)))
    fees = rng.uniform(0.0, 0.2, 200) if charged else None
    errors = np.column_stack([_oracle(rows, subspace) for subspace in subspaces])
    at, labels = np.arange(200), rng.integers(0, 5, 200).astype(np.int32)
    coherence = coherence_of(rng.random((200, 3)), 3.0)
    clusters = AffineClusters(
        rows, np.ones(200), labels.copy(), 5, depth=3, row_space=leading_row_space,
        coherence=coherence,
    )  # fmt: skip
    clusters.subspaces, clusters.errors = subspaces, errors[at, labels]
    paid = errors + (0.0 if fees is None else fees[:, None] * ranks)
    costs = _coherent_costs(coherence, labels, paid, unit)
    costs[paid > paid[at, labels][:, None]] = np.inf
    expected = np.argmin(costs, axis=1)
    moved = affine_classify.reclassify(clusters, fees)
    np.testing.assert_array_equal(clusters.labels, expected)
    assert moved == np.count_nonzero(expected != labels) > 20
    np.testing.assert_allclose(clusters.errors, errors[at, expected], rtol=1e-4)
    # by error alone other vertices move
    assert np.mean(expected != np.argmin(paid, axis=1)) > 0.1


def test_most_clusters_are_left_out_and_none_that_is_better(diffuse):
    clusters = _clusters(diffuse, np.arange(len(diffuse)) % 24, depth=3)
    for _ in range(4):
        clusters.find_components()
        clusters.use(np.full(24, 3))
        labels, errors = clusters.labels.copy(), clusters.errors.copy()
        clusters.move(propose_clusters(diffuse, clusters.subspaces, labels, errors))
    candidates = affine_classify._Candidates(clusters.subspaces)
    tried = 0
    for cluster in range(24):
        members = np.flatnonzero(labels == cluster)
        possible = affine_classify._possible(
            diffuse[members] - candidates.origin, cluster, candidates,
            errors[members], np.zeros(len(members)),
        )  # fmt: skip
        tried += possible.sum()
        for other, subspace in enumerate(clusters.subspaces):
            better = _oracle(diffuse[members], subspace) < errors[members]
            if other != cluster:
                assert np.all(possible[better, other])
    assert 0 < tried < 0.3 * 24 * len(diffuse)


def test_only_moves_that_pay_are_made(diffuse):
    clusters = _clusters(diffuse, np.arange(len(diffuse)) % 6)
    clusters.find_components()
    clusters.use(np.full(6, 2))
    before, labels = clusters.errors.copy(), clusters.labels.copy()
    proposed = (labels + 1) % 6
    there = np.array(
        [
            _oracle(row[None], clusters.subspaces[c])[0]
            for row, c in zip(diffuse, proposed, strict=True)
        ]
    )
    n_moved = clusters.move(proposed.astype(np.int32))
    moved = clusters.labels != labels
    assert 0 < n_moved == moved.sum() < len(diffuse)
    # but for those on a border, to rounding
    clear = np.abs(there - before) > 1e-5 * before
    np.testing.assert_array_equal(moved[clear], (there < before)[clear])
    assert np.all(clusters.errors <= before)
    np.testing.assert_allclose(clusters.errors[moved], there[moved], rtol=1e-3)


def test_clusters_that_nobody_left_or_joined_are_not_fitted_again(diffuse):
    calls = []

    def counted(matrix, rank):
        calls.append(len(matrix))
        return leading_row_space(matrix, rank)

    clusters = _clusters(diffuse, np.arange(len(diffuse)) % 6)
    clusters.row_space = counted
    clusters.find_components()
    assert len(calls) == 6
    clusters.use(np.full(6, 2))
    proposed = np.where(np.arange(len(diffuse)) < 100, 3, clusters.labels)
    proposed[clusters.labels > 3] = clusters.labels[clusters.labels > 3]
    assert clusters.move(proposed.astype(np.int32)) > 0
    clusters.find_components()
    assert len(calls) == 6 + 4
    clusters.use(np.array([2, 2, 2, 2, 2, 4]))
    fresh = _clusters(diffuse, clusters.labels.copy())
    fresh.find_components()
    fresh.use(clusters.ranks)
    assert clusters.errors.tobytes() == fresh.errors.tobytes()
    for one, other in zip(clusters.subspaces, fresh.subspaces, strict=True):
        assert one.basis.tobytes() == other.basis.tobytes()


def test_a_filled_cluster_has_its_donor_s_components_until_it_is_fitted(diffuse):
    labels = np.arange(len(diffuse)) % 4
    labels[labels == 2] = 1
    clusters = _clusters(diffuse, labels)
    clusters.find_components()
    clusters.use(np.array([3, 3, 0, 3]))
    errors = clusters.errors.copy()
    clusters.fill_empty_clusters()
    (donor,) = set(labels[clusters.labels == 2].tolist())
    assert clusters.subspaces[2] is clusters.subspaces[donor]
    assert clusters.ranks[2] == 3
    np.testing.assert_array_equal(clusters.errors, errors)
    before = clusters.squared_error
    clusters.find_components()
    clusters.use(clusters.ranks)
    assert clusters.squared_error < before


def test_a_copy_is_a_state_of_its_own(diffuse):
    clusters = _clusters(diffuse, np.arange(len(diffuse)) % 6)
    clusters.find_components()
    clusters.use(np.full(6, 2))
    kept = clusters.copy()
    labels, error = kept.labels.copy(), kept.squared_error
    clusters.move(propose_clusters(diffuse, clusters.subspaces, clusters.labels, clusters.errors))
    clusters.find_components()
    clusters.use(np.full(6, 3))
    assert clusters.squared_error < error
    assert kept.squared_error == error
    np.testing.assert_array_equal(kept.labels, labels)
