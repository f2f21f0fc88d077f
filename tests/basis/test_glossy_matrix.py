"""M = A^-1 B A^-1 R T against direct integration of the light that a point reflects."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.sh import HemisphereBasis, eval_sh, glossy_matrix, sh_rotation_matrix
from support.quadrature import hemisphere_quadrature


@pytest.fixture(scope="module")
def rule():
    return hemisphere_quadrature(16)


@pytest.fixture
def frames(rng):
    return Rotation.random(4, rng=rng).as_matrix()


def linear_gloss(v, s):
    """Positive, reciprocal, of degree 1 in either direction: bands of order 2 hold its views."""
    return 0.3 + 0.2 * v @ s.T + 0.1 * v[:, :1] * s[:, 0]


def peaked_gloss(v, s):
    mirrored = s * [-1.0, -1.0, 1.0]
    return np.maximum(0.0, v @ mirrored.T) ** 4


def brdf_matrix(gloss, n_out, n_in, rule):
    """B by quadrature over both hemispheres."""
    directions, weights = rule
    y_out = weights[:, None] * eval_sh(n_out, directions)
    y_in = (weights * directions[:, 2])[:, None] * eval_sh(n_in, directions)
    return y_out.T @ gloss(directions, directions) @ y_in


def transfer(frames, seen, n_rows, n_light, rule):
    """T in the world's axes: the light where the point sees it, zero below its horizon."""
    directions, weights = rule
    result = []
    for frame in frames:
        world = directions @ frame  # R^T d by rows
        y = weights[:, None] * eval_sh(n_rows, world)
        result.append(y.T @ (seen(directions)[:, None] * eval_sh(n_light, world)))
    return np.array(result)


def reflected(gloss, frame, seen, light, views, rule):
    """Exitant radiance by direct integration: the oracle."""
    directions, weights = rule
    radiance = seen(directions) * (eval_sh(round(len(light) ** 0.5), directions @ frame) @ light)
    return gloss(views, directions) @ (weights * directions[:, 2] * radiance)


def open_sky(directions):
    return np.ones(len(directions))


def wall(directions):
    """Smooth shade on one side, degree 1: bands two orders above the light's hold its product."""
    return 0.5 + 0.5 * directions[:, 0]


@pytest.mark.parametrize(("seen", "n_incident"), [(open_sky, 4), (wall, 5)])
def test_exact_where_the_bases_hold_everything(seen, n_incident, frames, rule, rng):
    incident = HemisphereBasis(n_incident, tolerance=0.0)
    exitant = HemisphereBasis(2, tolerance=0.0)
    brdf = brdf_matrix(linear_gloss, 2, n_incident, rule)
    t = transfer(frames, seen, n_incident, 4, rule)
    matrices = glossy_matrix(brdf, t, frames, incident=incident, exitant=exitant)
    assert matrices.shape == (4, 4, 16)  # N_r x N_i with fewer rows than columns
    light = rng.normal(size=16)
    views = rule[0]
    for frame, matrix in zip(frames, matrices, strict=True):
        expected = reflected(linear_gloss, frame, seen, light, views, rule)
        # 1e-10: rounding times a condition number of 1.5e5
        np.testing.assert_allclose(
            exitant.evaluate(views) @ (matrix @ light), expected, rtol=0, atol=1e-10
        )
    # negative twins: without A^-1 on either side; with the frame turned the other way
    plain = brdf @ sh_rotation_matrix(n_incident, frames[0]) @ t[0]
    expected = reflected(linear_gloss, frames[0], seen, light, views, rule)
    assert np.abs(exitant.evaluate(views) @ (plain @ light) - expected).max() > 0.01
    back = glossy_matrix(brdf, t[0], frames[0].T, incident=incident, exitant=exitant)
    assert np.abs(exitant.evaluate(views) @ (back @ light) - expected).max() > 0.01


def test_formula_by_dense_matrices(frames, rule):
    """Functions dropped on both sides, another number on each."""
    incident, exitant = HemisphereBasis(6), HemisphereBasis(5)
    brdf = brdf_matrix(peaked_gloss, 5, 6, rule)
    t = transfer(frames, wall, 6, 4, rule)
    matrices = glossy_matrix(brdf, t, frames, incident=incident, exitant=exitant)
    assert matrices.shape == (4, 24, 16)
    local = sh_rotation_matrix(6, frames) @ t
    inner = incident.inverse_gram @ local[:, incident.kept]
    expected = exitant.inverse_gram @ brdf[np.ix_(exitant.kept, incident.kept)] @ inner
    np.testing.assert_allclose(matrices, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_least_squares_rows_beat_more_zero_hemisphere_rows(frames, rule, rng):
    """16 optimal rows against 25 plain ones, as in figure 7 of the paper, for a Phong lobe."""
    directions, weights = rule
    t = transfer(frames, open_sky, 5, 5, rule)
    optimal = glossy_matrix(
        brdf_matrix(peaked_gloss, 4, 5, rule), t, frames,
        incident=HemisphereBasis(5), exitant=HemisphereBasis(4),
    )  # fmt: skip
    plain = brdf_matrix(peaked_gloss, 5, 5, rule) @ sh_rotation_matrix(5, frames) @ t
    errors = np.zeros(2)
    for frame, m_optimal, m_plain in zip(frames, optimal, plain, strict=True):
        light = rng.normal(size=25)
        expected = reflected(peaked_gloss, frame, open_sky, light, directions, rule)
        fits = (
            eval_sh(4, directions) @ (m_optimal @ light),
            eval_sh(5, directions) @ (m_plain @ light),
        )
        errors += [weights @ (fit - expected) ** 2 for fit in fits]
    assert errors[0] < 0.5 * errors[1]  # 0.0018 against 0.0058 of the energy measured


def test_matrices_of_other_orders_are_refused(rule, frames):
    incident, exitant = HemisphereBasis(3), HemisphereBasis(2)
    brdf = brdf_matrix(linear_gloss, 2, 3, rule)
    t = transfer(frames, open_sky, 3, 2, rule)
    with pytest.raises(SettingsError, match=r"must be \(16, 9\), got \(4, 9\)"):
        glossy_matrix(brdf, t, frames, incident=incident, exitant=HemisphereBasis(4))
    with pytest.raises(SettingsError, match="transfer must have 4 rows, got 9"):
        glossy_matrix(
            brdf_matrix(linear_gloss, 2, 2, rule), t, frames, incident=exitant, exitant=exitant
        )
