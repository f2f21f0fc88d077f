import numpy as np
import pytest
from tensorly.decomposition import partial_tucker

from prtbake_workers.compress.cluster_factors import (
    ClusterFactors,
    fit_cluster,
    light_step,
    project_light,
    projected_weights,
    squared_residuals,
    vertex_basis,
    vertex_step,
)

RANKS = (10, 7)  # light, vert


@pytest.fixture
def z(glossy):
    return np.ascontiguousarray(glossy[::5, :5])


def _fit(z, roots, sweeps, start=None):
    return fit_cluster(z, roots, *RANKS, start=start, sweeps=sweeps)[0]


def _reconstructed(z, factors):
    """Eq. 18 of Tsai & Shih in float64, one vertex at a time, without the view basis."""
    light, dual = factors.light.astype(float), factors.dual.astype(float)
    out = np.empty(z.shape)
    for x, matrix in enumerate(z.astype(float)):
        w = dual @ (matrix @ light).reshape(-1)
        out[x] = (dual.T @ w).reshape(len(matrix), -1) @ light.T
    return out


def test_converged_sweeps_reach_the_error_of_partial_tucker(z):
    error = squared_residuals(z, _fit(z, np.ones(len(z)), 30)).sum()
    (core, _), _ = partial_tucker(
        z.astype(float), rank=[RANKS[1], RANKS[0]], modes=[0, 2], n_iter_max=200, tol=1e-10
    )
    oracle = np.sum(z.astype(float) ** 2) - np.sum(core**2)
    # Two local searches from the same start: equal to what their stopping leaves, 1e-4 here.
    np.testing.assert_allclose(error, oracle, rtol=1e-3)
    unfitted = squared_residuals(z, _fit(z[:60], np.ones(60), 30)).sum()
    assert not np.isclose(unfitted, oracle, rtol=1e-3)


def test_residuals_are_those_of_the_reconstruction(z):
    factors = _fit(z, np.ones(len(z)), 1)
    expected = np.sum((z - _reconstructed(z, factors)) ** 2, axis=(1, 2))
    # The residual is a float32 difference: 1e-7 of the signal against residuals of 1e-1 of it.
    np.testing.assert_allclose(squared_residuals(z, factors), expected, rtol=1e-4)
    wrong = ClusterFactors(factors.light, factors.dual[:, ::-1].copy())
    assert not np.allclose(squared_residuals(z, wrong), expected, rtol=1e-4)


def test_bases_are_orthonormal(z):
    light, dual = _fit(z, np.ones(len(z)), 1)
    np.testing.assert_allclose(light.T @ light, np.eye(RANKS[0]), atol=1e-6)
    np.testing.assert_allclose(dual @ dual.T, np.eye(RANKS[1]), atol=1e-6)


def test_warm_sweeps_never_lose_even_after_the_members_changed(z, rng):
    roots = np.ones(len(z))
    factors = _fit(z[:40], roots[:40], 3)
    before = squared_residuals(z, factors).sum()
    for _ in range(6):
        factors = _fit(z, roots, 1, factors)
        after = squared_residuals(z, factors).sum()
        assert after <= before + 1e-7 * np.sum(z.astype(float) ** 2)
        before = after
    random = np.linalg.qr(rng.standard_normal((z.shape[2], RANKS[0])))[0].astype(np.float32)
    assert (
        squared_residuals(
            z, ClusterFactors(random, vertex_step(project_light(z, random), roots, RANKS[1]))
        ).sum()
        > before
    )


def test_the_light_step_is_the_best_for_its_vertex_basis(z):
    factors = _fit(z, np.ones(len(z)), 0)
    u_vert = vertex_basis(projected_weights(z, factors), np.ones(len(z)))
    light = light_step(z, u_vert, np.ones(len(z)), RANKS[0]).astype(float)
    unfolded = np.einsum("vr,vkl->rkl", u_vert, z.astype(float)).reshape(-1, z.shape[2])
    singular = np.linalg.svd(unfolded)[1]
    captured = np.sum((unfolded @ light) ** 2)
    np.testing.assert_allclose(captured, np.sum(singular[: RANKS[0]] ** 2), rtol=1e-6)
    assert not np.isclose(captured, np.sum(singular[1 : RANKS[0] + 1] ** 2), rtol=1e-6)


def test_weights_scale_the_vertices(z, rng):
    roots = rng.random(len(z)) + 0.5
    weighted = _fit(z, roots, 2)
    scaled = _fit((z * roots[:, None, None]).astype(np.float32), np.ones(len(z)), 2)
    for one, other in zip(weighted, scaled, strict=True):
        one, other = (f if f.shape[0] < f.shape[1] else f.T for f in (one, other))
        # The subspaces agree to float32 noise over the smallest gap in the spectrum.
        np.testing.assert_allclose(one.T @ one, other.T @ other, atol=1e-3)
    plain = _fit(z, np.ones(len(z)), 2)
    assert not np.allclose(weighted.dual.T @ weighted.dual, plain.dual.T @ plain.dual, atol=1e-3)


def test_folding_gives_the_same_weights_in_one_product(z):
    factors = _fit(z, np.ones(len(z)), 1)
    folded = factors.folded(z.shape[1])
    expected = projected_weights(z, factors)
    np.testing.assert_allclose(z.reshape(len(z), -1) @ folded.T, expected, atol=1e-5)
    turned = ClusterFactors(factors.light[::-1].copy(), factors.dual).folded(z.shape[1])
    assert not np.allclose(z.reshape(len(z), -1) @ turned.T, expected, atol=1e-5)


def test_sweeps_from_a_start_come_as_near_as_the_best_steps(z):
    """Each step takes one iteration, and the sweeps repeat it: monotone, and to the same end."""
    ones = np.ones(len(z))
    start = _fit(z, ones, 0)
    errors = [squared_residuals(z, start).sum()]
    factors = start
    for _ in range(30):
        factors = _fit(z, ones, 1, factors)
        errors.append(squared_residuals(z, factors).sum())
    # residuals are float32 differences
    assert (np.diff(errors) < 1e-6 * errors[0]).all()
    best = squared_residuals(z, _fit(z, ones, 30)).sum()
    assert errors[0] > 1.01 * best
    np.testing.assert_allclose(errors[-1], best, rtol=1e-3)
