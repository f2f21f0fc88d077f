"""Hemispherical Gram matrix and projection errors against quadrature and the paper's formulas."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.sh import eval_sh, hemisphere_gram, hemisphere_projection_error
from support.quadrature import hemisphere_quadrature, sphere_quadrature


def quadrature_gram(order):
    """The oracle: an independent product rule over z >= 0."""
    directions, weights = hemisphere_quadrature(order + 3)
    values = eval_sh(order, directions)
    return values.T @ (weights[:, None] * values)


def degrees_and_orders(order):
    degrees = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    return degrees, np.arange(order**2) - degrees * (degrees + 1)


@pytest.mark.parametrize("order", [1, 2, 5, 10])
def test_gram_equals_quadrature(order):
    gram = hemisphere_gram(order)
    np.testing.assert_allclose(gram, quadrature_gram(order), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(gram, gram.T)
    degrees, m = degrees_and_orders(order)
    same_parity = (degrees[:, None] + m[:, None] - degrees - m) % 2 == 0
    # of one parity in z: half of what the sphere gives
    np.testing.assert_allclose(gram[same_parity], 0.5 * np.eye(order**2)[same_parity], atol=1e-14)
    if order > 1:  # negative twin
        assert np.abs(gram - 0.5 * np.eye(order**2)).max() > 0.4


def test_published_singular_values_of_order_5():
    values = np.linalg.svd(hemisphere_gram(5), compute_uv=False)
    assert f"{values[0]:.3f}" == "1.000"
    assert f"{values[-1]:.3e}" == "6.592e-06"
    assert f"{values[-2]:.3e}" == "3.096e-04"


def test_published_function_to_drop():
    """1 / (A^-1)_kk, the squared error of y_k as fitted by the rest, is least for l = 1, m = 0."""
    errors = 1.0 / np.diag(np.linalg.inv(hemisphere_gram(5)))
    assert np.argmin(errors) == 2
    assert f"{errors[2]:.3e}" == "1.477e-05"
    assert np.sort(errors)[1] > 1.5 * errors[2]


@pytest.mark.parametrize(
    ("method", "projection_order", "largest", "mean"),
    [
        ("zero", None, "0.1250", "0.04021"),
        ("odd", None, "0.1453", "0.04438"),
        ("even", None, "0.02201", "0.003578"),
        ("even", 5, "0.1930", "0.03041"),
    ],
)
def test_published_errors_of_order_5(method, projection_order, largest, mean):
    errors = hemisphere_projection_error(5, method, projection_order=projection_order)
    digits = [len(text.lstrip("0.")) for text in (largest, mean)]
    assert [f"{e:#.{d}g}" for e, d in zip(errors, digits, strict=True)] == [largest, mean]


@pytest.mark.parametrize("order", [1, 3, 5, 8, 12])
def test_least_squares_represents_its_own_functions(order):
    assert max(hemisphere_projection_error(order, "least_squares")) < 1e-25


@pytest.mark.parametrize(("method", "comparable"), [("odd", 8), ("even", 7), ("zero", 5)])
def test_comparable_order_of_order_5(method, comparable):
    """28 of 64 functions are odd, 28 of 49 even: at least as many as the signal's 25."""
    errors = hemisphere_projection_error(5, method)
    assert errors == hemisphere_projection_error(5, method, projection_order=comparable)
    degrees, m = degrees_and_orders(comparable)
    used = {"odd": (degrees + m) % 2 == 1, "even": (degrees + m) % 2 == 0}.get(method, m == m)
    assert used.sum() >= 25
    fewer = hemisphere_projection_error(5, method, projection_order=comparable - 1)
    assert fewer[0] > errors[0]


def paper_error(order, projection_order, scale):
    """E = c^T (D A - I)^T A (D A - I) c, [Sloan2003] 9.2, with dense matrices."""
    largest = max(order, projection_order)
    gram = quadrature_gram(largest)
    degrees, m = degrees_and_orders(largest)
    factors = scale(degrees + m) * (degrees < projection_order)
    difference = (factors[:, None] * gram - np.eye(largest**2))[:, : order**2]
    values = np.linalg.svd(difference.T @ gram @ difference, compute_uv=False)
    return values[0], values.mean()


SCALES = {
    "zero": lambda parity: np.ones(len(parity)),
    "odd": lambda parity: 2.0 * (parity % 2),
    "even": lambda parity: 2.0 * (1 - parity % 2),
}


@pytest.mark.parametrize("method", SCALES)
@pytest.mark.parametrize(("order", "projection"), [(1, 1), (2, 5), (4, 4), (5, 3), (5, 8), (7, 10)])
def test_errors_equal_the_formula_in_the_paper(method, order, projection):
    errors = hemisphere_projection_error(order, method, projection_order=projection)
    expected = paper_error(order, projection, SCALES[method])
    np.testing.assert_allclose(errors, expected, rtol=1e-12, atol=1e-14)


def test_parities_as_printed_are_swapped():
    """y(z) = +y(-z) called odd, as 9.2 prints, gives none of the paper's own figures."""
    as_printed = paper_error(5, 8, SCALES["even"])
    assert abs(as_printed[0] - 0.1453) > 0.1
    assert paper_error(5, 8, SCALES["odd"])[0] == pytest.approx(0.1453, abs=5e-5)


@pytest.mark.parametrize("method", ["zero", "odd", "even"])
def test_one_signal_projected_by_hand(method, rng):
    """Continue a signal below the horizon, project it on the sphere, integrate the error."""
    order, projection = 4, 6
    coeffs = rng.normal(size=16)
    coeffs /= np.linalg.norm(coeffs)
    directions, weights = hemisphere_quadrature(12)
    signal = eval_sh(order, directions) @ coeffs
    below = {"zero": 0.0, "odd": -1.0, "even": 1.0}[method]
    mirror = directions * [1.0, 1.0, -1.0]
    projected = eval_sh(projection, directions).T @ (weights * signal)
    projected += below * eval_sh(projection, mirror).T @ (weights * signal)
    error = weights @ (eval_sh(projection, directions) @ projected - signal) ** 2
    largest, _ = hemisphere_projection_error(order, method, projection_order=projection)
    assert 0.0 < error <= largest
    # the mean over an orthonormal set of signals is the mean of all
    table = eval_sh(order, directions)
    fits = eval_sh(projection, directions).T @ (weights[:, None] * table)
    fits += below * eval_sh(projection, mirror).T @ (weights[:, None] * table)
    errors = weights @ (eval_sh(projection, directions) @ fits - table) ** 2
    _, mean = hemisphere_projection_error(order, method, projection_order=projection)
    assert mean == pytest.approx(errors.mean(), rel=1e-11)


def test_least_squares_on_fewer_functions_equals_numpy():
    directions, weights = hemisphere_quadrature(10)
    root = np.sqrt(weights)[:, None]
    signals, functions = root * eval_sh(5, directions), root * eval_sh(4, directions)
    missed = signals - functions @ np.linalg.lstsq(functions, signals, rcond=None)[0]
    values = np.linalg.svd(missed, compute_uv=False) ** 2
    errors = hemisphere_projection_error(5, "least_squares", projection_order=4)
    np.testing.assert_allclose(errors, [values[0], values.mean()], rtol=1e-9)
    # it is the least of all: no reflection does as well with the same functions
    for method in SCALES:
        other = hemisphere_projection_error(5, method, projection_order=4)
        assert other[0] > (1.0 - 1e-12) * errors[0]
        assert other[1] > 1.01 * errors[1]


def test_bad_arguments_are_refused_by_name():
    with pytest.raises(SettingsError, match="method is one of zero, odd, even, least_squares"):
        hemisphere_projection_error(5, "mirror")
    with pytest.raises(SettingsError, match="at least 1, got 0"):
        hemisphere_projection_error(5, "zero", projection_order=0)
    with pytest.raises(SettingsError, match="at least 1, got -2"):
        hemisphere_gram(-2)


def test_two_hemispheres_make_a_sphere():
    """A above and below the horizon sum to the identity."""
    gram = hemisphere_gram(7)
    degrees, m = degrees_and_orders(7)
    signs = (-1.0) ** (degrees + m)
    whole = gram + signs[:, None] * gram * signs
    np.testing.assert_allclose(whole, np.eye(49), rtol=0, atol=1e-14)
    directions, weights = sphere_quadrature(7)
    values = eval_sh(7, directions)
    np.testing.assert_allclose(whole, values.T @ (weights[:, None] * values), rtol=0, atol=1e-13)
