import numpy as np
import pytest

from prtbake_workers.compress.classify import propose_clusters, reclassify
from prtbake_workers.compress.cluster_factors import (
    ClusterFactors,
    fit_cluster,
    rank_zero,
    squared_residuals,
)


def _random_factors(rng, z, n_clusters, r_light=6, r_vert=4):
    _, r_view, n_coeffs = z.shape
    return [
        ClusterFactors(
            np.linalg.qr(rng.standard_normal((n_coeffs, r_light)))[0].astype(np.float32),
            np.linalg.qr(rng.standard_normal((r_view * r_light, r_vert)))[0].T.astype(np.float32),
        )
        for _ in range(n_clusters)
    ]


def _brute_force_errors(z, factors):
    """||Z_x - Z~_x,c||^2 by eqs. 17 and 18 of Tsai & Shih, in float64: (verts, clusters)."""
    errors = np.empty((len(z), len(factors)))
    for c, (light, dual) in enumerate(factors):
        light, dual = light.astype(float), dual.astype(float)
        for x, matrix in enumerate(z.astype(float)):
            w = dual @ (matrix @ light).reshape(-1)
            approximated = (dual.T @ w).reshape(len(matrix), -1) @ light.T
            errors[x, c] = np.sum((matrix - approximated) ** 2)
    return errors


@pytest.fixture
def z(glossy):
    return np.ascontiguousarray(glossy[::6, :5])


def test_proposals_are_those_of_brute_force(z, rng):
    factors = _random_factors(rng, z, 7)
    errors = _brute_force_errors(z, factors)
    labels = rng.integers(0, 7, len(z)).astype(np.int32)
    own = errors[np.arange(len(z)), labels]
    proposed = propose_clusters(z, factors, labels, own)
    chosen = errors[np.arange(len(z)), proposed]
    energy = np.sum(z.astype(float) ** 2, axis=(1, 2))
    assert np.all(chosen <= errors.min(axis=1) + 1e-6 * energy)
    wrong = [ClusterFactors(f.light, f.dual[:, ::-1].copy()) for f in factors]
    chosen = errors[np.arange(len(z)), propose_clusters(z, wrong, labels, own)]
    assert not np.all(chosen <= errors.min(axis=1) + 1e-6 * energy)


def test_clusters_of_different_rank_are_compared_fairly(z, rng):
    factors = [_random_factors(rng, z, 1, r_light=2 + c, r_vert=1 + c)[0] for c in range(5)]
    factors.append(rank_zero(z.shape[2]))
    errors = _brute_force_errors(z, factors)
    best = np.argmin(errors, axis=1)
    labels = np.full(len(z), 5, np.int32)
    np.testing.assert_array_equal(propose_clusters(z, factors, labels, errors[:, 5]), best)


def test_the_bound_leaves_out_no_better_cluster(glossy):
    """On fitted clusters, where it leaves out many; and with errors that are too small it does."""
    z = np.ascontiguousarray(glossy[:, :5])
    labels = (np.arange(len(z)) // 30).astype(np.int32)
    ones = np.ones(len(z))
    fits = [fit_cluster(z[labels == c], ones[:30], 8, 4, start=None, sweeps=1) for c in range(20)]
    factors, errors = [f for f, _ in fits], np.concatenate([e for _, e in fits])
    brute = _brute_force_errors(z, factors)
    chosen = brute[np.arange(len(z)), propose_clusters(z, factors, labels, errors)]
    energy = np.sum(z.astype(float) ** 2, axis=(1, 2))
    assert np.count_nonzero(np.argmin(brute, axis=1) != labels) > 20
    assert np.all(chosen <= brute.min(axis=1) + 1e-6 * energy)
    wrong = brute[np.arange(len(z)), propose_clusters(z, factors, labels, 1e-4 * errors)]
    assert not np.all(wrong <= brute.min(axis=1) + 1e-6 * energy)


def test_nobody_moves_between_equal_clusters(z, rng):
    # The product may round equal columns differently, so proposals differ; residuals do not.
    factors = _random_factors(rng, z, 1) * 3
    labels = np.full(len(z), 2, np.int32)
    errors = squared_residuals(z, factors[2])
    assert reclassify(z, factors, labels, errors) == 0
    assert np.all(labels == 2)


def test_reclassified_errors_are_those_of_the_new_clusters(z, rng):
    factors = _random_factors(rng, z, 5)
    labels = np.zeros(len(z), np.int32)
    errors = squared_residuals(z, factors[0])
    before = errors.copy()
    moved = reclassify(z, factors, labels, errors)
    assert moved == np.count_nonzero(labels) > 0
    brute = _brute_force_errors(z, factors)
    np.testing.assert_allclose(errors, brute[np.arange(len(z)), labels], rtol=1e-4)
    assert np.all(errors <= before)
    assert not np.allclose(errors, brute[:, 0], rtol=1e-4)


def test_rounding_moves_nobody_near_zero_error(z, rng):
    # Both clusters hold the vertex up to float32 noise, where ||Z||^2 - ||w||^2 is noise alone.
    basis = _random_factors(rng, z, 1, r_light=6, r_vert=12)[0]
    inside = (rng.standard_normal((50, 12)).astype(np.float32) @ basis.folded(z.shape[1])).reshape(
        50, *z.shape[1:]
    )
    turn = np.linalg.qr(rng.standard_normal((12, 12)))[0].astype(np.float32)
    factors = [basis, ClusterFactors(basis.light, turn @ basis.dual)]
    labels = np.zeros(50, np.int32)
    errors = squared_residuals(inside, basis)
    energy = np.sum(inside.astype(float) ** 2, axis=(1, 2))
    assert np.all(errors < 1e-11 * energy)
    before = errors.sum()
    reclassify(inside, factors, labels, errors)
    assert errors.sum() <= before
    # The difference of energies in float32 would have been wrong by far more than that.
    weights = inside.reshape(50, -1) @ basis.folded(z.shape[1]).T
    difference = energy.astype(np.float32) - np.sum(weights**2, axis=1)
    assert np.abs(difference - errors).max() > 1e3 * errors.max()
