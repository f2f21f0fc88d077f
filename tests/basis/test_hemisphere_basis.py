"""Least-squares optimal hemispherical coefficients against dense least squares."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.hemisphere_basis import DROP_TOLERANCE
from prtbake_workers.basis.sh import HemisphereBasis, eval_sh, hemisphere_gram
from prtbake_workers.transport.directions import cube_directions
from support.quadrature import hemisphere_quadrature, random_directions

AXIS = np.array([0.36, 0.48, 0.8])


@pytest.fixture(scope="module")
def rule():
    return hemisphere_quadrature(40)


def lobe(directions):
    """Smooth and of no finite order."""
    return np.exp(6.0 * (directions @ AXIS - 1.0)) + 0.2 * directions[:, 2]


def squared_error(basis, coeffs, rule):
    directions, weights = rule
    return weights @ (basis.evaluate(directions) @ coeffs - lobe(directions)) ** 2


@pytest.mark.parametrize("order", [1, 3, 5, 8])
def test_zero_hemisphere_projection_becomes_the_best_fit(order, rule):
    directions, weights = rule
    basis = HemisphereBasis(order)
    projection = eval_sh(order, directions).T @ (weights * lobe(directions))
    coeffs = basis.from_zero_hemisphere(projection)
    root = np.sqrt(weights)
    expected = np.linalg.lstsq(
        root[:, None] * basis.evaluate(directions), root * lobe(directions), rcond=None
    )[0]
    # 1e-10: rounding of the projection times a condition number of 3e4
    np.testing.assert_allclose(coeffs, expected, rtol=0, atol=1e-10)
    # negative twin: without A^-1 the fit is worse on the hemisphere
    best = squared_error(basis, coeffs, rule)
    assert squared_error(basis, projection[basis.kept], rule) > 1.2 * best


def test_only_l_1_m_0_is_dropped_at_order_5():
    basis = HemisphereBasis(5)
    assert basis.n == 24
    assert basis.dropped.tolist() == [2]
    assert f"{basis.drop_error:.3e}" == "1.477e-05"
    gram = hemisphere_gram(5)[np.ix_(basis.kept, basis.kept)]
    assert basis.condition == pytest.approx(np.linalg.cond(gram), rel=1e-9)
    np.testing.assert_allclose(basis.inverse_gram @ gram, np.eye(24), rtol=0, atol=1e-11)


@pytest.mark.parametrize("order", [6, 8, 10])
def test_drop_error_is_the_worst_signal_of_the_dropped(order):
    """Schur complement of the dense Gram matrix."""
    basis = HemisphereBasis(order)
    gram = hemisphere_gram(order)
    kept, dropped = basis.kept, basis.dropped
    across = gram[np.ix_(kept, dropped)]
    rest = np.linalg.solve(gram[np.ix_(kept, kept)], across)
    schur = gram[np.ix_(dropped, dropped)] - across.T @ rest
    assert basis.drop_error == pytest.approx(np.linalg.eigvalsh(schur)[-1], rel=1e-5)
    assert basis.drop_error <= DROP_TOLERANCE


@pytest.mark.parametrize("order", [6, 8, 10, 12])
def test_pairs_of_one_azimuthal_order_go_together(order):
    basis = HemisphereBasis(order)
    degrees = np.floor(np.sqrt(basis.dropped)).astype(int)
    partners = 2 * degrees * (degrees + 1) - basis.dropped  # l (l + 1) - m
    assert len(basis.dropped) > 1
    assert set(partners) == set(basis.dropped)
    assert basis.condition < 5e4


def test_dropping_one_more_function_would_pass_the_tolerance():
    """The stated criterion, by brute force: no other function of order 5 can go too."""
    basis = HemisphereBasis(5)
    gram = hemisphere_gram(5)
    for more in basis.kept:
        dropped = [*basis.dropped, more]
        kept = np.setdiff1d(basis.kept, [more])
        across = gram[np.ix_(kept, dropped)]
        rest = np.linalg.solve(gram[np.ix_(kept, kept)], across)
        schur = gram[np.ix_(dropped, dropped)] - across.T @ rest
        assert np.linalg.eigvalsh(schur)[-1] > DROP_TOLERANCE
    assert HemisphereBasis(5, tolerance=0.0).n == 25
    assert HemisphereBasis(5, tolerance=0.01).n < 24


def test_restriction_of_an_expansion_of_its_order(rng, rule):
    whole = HemisphereBasis(5, tolerance=0.0)
    coeffs = rng.normal(size=(3, 25))
    # 1e-11: rounding times the root of the condition number
    np.testing.assert_allclose(whole.from_sphere(coeffs), coeffs, rtol=0, atol=1e-11)
    # with a function dropped the radiance stays, to what the drop may cost
    basis = HemisphereBasis(5)
    directions, weights = rule
    fitted = basis.from_sphere(coeffs) @ basis.evaluate(directions).T
    missed = weights @ (fitted - coeffs @ eval_sh(5, directions).T).T ** 2
    # the function lost is all there is to the error
    np.testing.assert_allclose(missed, basis.drop_error * coeffs[:, 2] ** 2, rtol=1e-6)
    cut = weights @ ((coeffs[:, 2:3] * eval_sh(5, directions)[:, 2]).T) ** 2
    assert (cut > 1e4 * missed).all()


@pytest.mark.parametrize("order", [3, 9])
def test_restriction_of_another_order(order, rng, rule):
    """Against b = A c by quadrature."""
    directions, weights = rule
    basis = HemisphereBasis(5)
    expansion = rng.normal(size=order**2)
    signal = eval_sh(order, directions) @ expansion
    projection = eval_sh(5, directions).T @ (weights * signal)
    expected = basis.from_zero_hemisphere(projection)
    np.testing.assert_allclose(basis.from_sphere(expansion), expected, rtol=0, atol=1e-10)


def test_samples_of_a_coarse_cube_give_the_function_back(rng):
    cube = cube_directions(8)
    above = cube.directions[:, 2] >= 0.0
    basis = HemisphereBasis(6)
    projection = basis.sample_projection(cube.directions[above], cube.weights[above])
    coeffs = rng.normal(size=(4, basis.n))
    samples = coeffs @ basis.evaluate(cube.directions[above]).T
    np.testing.assert_allclose(samples @ projection.matrix, coeffs, rtol=0, atol=1e-10)
    # negative twin: the exact A^-1 with the same directions as a quadrature
    projections = (samples * cube.weights[above]) @ eval_sh(6, cube.directions[above])
    assert np.abs(basis.from_zero_hemisphere(projections) - coeffs).max() > 0.01


def test_condition_of_samples_tends_to_that_of_the_integral():
    basis = HemisphereBasis(6)
    conditions = []
    for resolution in (8, 16, 64):
        cube = cube_directions(resolution)
        above = cube.directions[:, 2] >= 0.0
        projection = basis.sample_projection(cube.directions[above], cube.weights[above])
        conditions.append(projection.condition / basis.condition)
    # texels that the horizon cuts: the error falls with their size
    assert conditions[0] > conditions[1] > conditions[2] > 1.0
    assert conditions[2] < 1.2


def test_samples_are_weighted_by_their_solid_angles(rule):
    directions, weights = rule
    basis = HemisphereBasis(4)
    fit = lobe(directions) @ basis.sample_projection(directions, weights).matrix
    projection = eval_sh(4, directions).T @ (weights * lobe(directions))
    np.testing.assert_allclose(fit, basis.from_zero_hemisphere(projection), rtol=0, atol=1e-11)
    even = lobe(directions) @ basis.sample_projection(directions, np.ones(len(weights))).matrix
    assert np.abs(even - fit).max() > 1e-3


def test_completed_coefficients_are_those_of_the_sphere(rng, rule):
    basis = HemisphereBasis(7)
    coeffs = rng.normal(size=(2, basis.n))
    whole = basis.complete(coeffs)
    assert whole.shape == (2, 49)
    np.testing.assert_allclose(
        whole @ eval_sh(7, rule[0]).T, coeffs @ basis.evaluate(rule[0]).T, rtol=0, atol=1e-13
    )


def test_what_cannot_be_fitted_is_refused(rng):
    basis = HemisphereBasis(5)
    directions = random_directions(rng, 60)
    directions[:, 2] = np.abs(directions[:, 2])
    weights = np.ones(60)
    with pytest.raises(SettingsError, match="20 directions do not determine 24 functions"):
        basis.sample_projection(directions[:20], weights[:20])
    equal = np.tile(directions[:1], (60, 1))
    with pytest.raises(SettingsError, match="60 directions do not determine 24 functions"):
        basis.sample_projection(equal, weights)
    weights[7] = 0.0
    with pytest.raises(SettingsError, match="solid angle 7 is not positive"):
        basis.sample_projection(directions, weights)
    directions[4, 2] *= -1.0
    with pytest.raises(SettingsError, match="direction 4 lies below the horizon"):
        basis.evaluate(directions)
    with pytest.raises(SettingsError, match="tolerance must be at least 0 and below"):
        HemisphereBasis(5, tolerance=0.5)
