"""Rotations at their poles and near nothing, a thousand in a row; Gram matrices near singular."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.sh import (
    HemisphereBasis,
    eval_sh,
    hemisphere_gram,
    rotate_sh,
    sh_rotation_matrix,
)
from support.quadrature import hemisphere_quadrature, sphere_quadrature

ORDER = 10
DEGREES = np.repeat(np.arange(ORDER), 2 * np.arange(ORDER) + 1)
M = np.arange(ORDER**2) - DEGREES * (DEGREES + 1)


def reprojected(coeffs, rotation):
    order = round(len(coeffs) ** 0.5)
    directions, weights = sphere_quadrature(order)
    values = eval_sh(order, directions @ rotation) @ coeffs
    return (weights[:, None] * eval_sh(order, directions)).T @ values


@pytest.fixture
def coeffs(rng):
    return rng.normal(size=ORDER**2)


def about(axis, angle):
    return Rotation.from_rotvec(angle * np.array(axis) / np.linalg.norm(axis)).as_matrix()


AXES = [(1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0), (0, -1, 0), (0, 0, -1), (1, 1, 0), (1, -2, 3)]


def test_rotation_by_nothing(coeffs):
    # one rounding a product of each of the two quarter turns
    np.testing.assert_allclose(rotate_sh(coeffs, np.eye(3)), coeffs, rtol=0, atol=1e-14)
    many = np.cos(np.arange(10_000.0))
    np.testing.assert_allclose(rotate_sh(many, np.eye(3)), many, rtol=0, atol=5e-14)


@pytest.mark.parametrize(
    ("signs", "parity"),
    [
        ([1, -1, -1], (-1.0) ** DEGREES * (-1.0) ** M * np.where(M < 0, -1, 1)),
        ([-1, 1, -1], (-1.0) ** DEGREES * np.where(M < 0, -1, 1)),
        ([-1, -1, 1], (-1.0) ** M),
    ],
)
def test_half_turns_about_the_axes_change_signs_only(signs, parity, coeffs):
    half_turn = np.diag(np.array(signs, dtype=float))
    np.testing.assert_allclose(rotate_sh(coeffs, half_turn), parity * coeffs, rtol=0, atol=1e-14)
    assert np.abs(parity * coeffs - coeffs).max() > 0.1


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-12, np.pi + 1e-8, 0.5 * np.pi, 1e-8, 1e-4])
def test_every_axis_equals_reprojection(axis, angle, coeffs):
    rotation = about(axis, angle)
    np.testing.assert_allclose(
        rotate_sh(coeffs, rotation), reprojected(coeffs, rotation), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("off", [0.0, 1e-300, 1e-16, 1e-12, 1e-9, 1e-6])
@pytest.mark.parametrize("pole", [0.0, np.pi])
def test_poles_of_the_angles(off, pole, coeffs):
    """z goes to z or -z, all but: the two turns about z are not unique, or hardly."""
    rotation = about((0, 0, 1), 0.7) @ about((0, 1, 0), pole + off) @ about((0, 0, 1), -1.9)
    np.testing.assert_allclose(
        rotate_sh(coeffs, rotation), reprojected(coeffs, rotation), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("axis", AXES)
def test_rotation_by_1e_12(axis, coeffs):
    """The change is the angle times the generator, here by central differences of the oracle."""
    step = 1e-4
    generator = reprojected(coeffs, about(axis, step)) - reprojected(coeffs, about(axis, -step))
    generator /= 2 * step
    change = rotate_sh(coeffs, about(axis, 1e-12)) - coeffs
    # 1e-14 of rounding beside a change of up to 9e-12; the differences are good to 1e-5
    np.testing.assert_allclose(change, 1e-12 * generator, rtol=0, atol=2e-14)
    assert np.abs(change).max() > 1e-12
    assert np.abs(change + 1e-12 * generator).max() > 1e-12


def test_1000_rotations_equal_their_product(coeffs, rng):
    rotations = Rotation.random(1000, rng=rng).as_matrix()
    turned, product, reverse = coeffs, np.eye(3), np.eye(3)
    for rotation in rotations:
        turned = rotate_sh(turned, rotation)
        product, reverse = rotation @ product, reverse @ rotation
    # 1e-12: a thousand roundings of one size each, 3e-13 measured
    np.testing.assert_allclose(turned, rotate_sh(coeffs, product), rtol=0, atol=1e-12)
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(coeffs), rel=1e-13)
    assert np.abs(turned - rotate_sh(coeffs, reverse)).max() > 0.1


def test_1000_matrices_equal_the_matrix_of_the_product(rng):
    rotations = Rotation.random(1000, rng=rng).as_matrix()
    matrices = sh_rotation_matrix(5, rotations)
    product, matrix = np.eye(3), np.eye(25)
    for rotation, factor in zip(rotations, matrices, strict=True):
        product, matrix = rotation @ product, factor @ matrix
    np.testing.assert_allclose(matrix, sh_rotation_matrix(5, product), rtol=0, atol=1e-12)


def test_a_rotation_of_float32_is_taken_by_its_angles(coeffs):
    exact = about((1, -2, 3), 1.1)
    rounded = exact.astype(np.float32).astype(np.float64)
    turned = rotate_sh(coeffs, rounded)
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(coeffs), rel=1e-13)
    np.testing.assert_allclose(turned, rotate_sh(coeffs, exact), rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.diag([1.0, 1.0, -1.0]), "the rotation is a reflection: its determinant is -1"),
        (-np.eye(3), "the rotation is a reflection: its determinant is -1"),
        (1.01 * np.eye(3), "the rotation is not orthogonal: R^T R differs from 1 by 0.06"),
        (np.zeros((3, 3)), "the rotation is not orthogonal: R^T R differs from 1 by 3"),
        (np.eye(3) + np.triu(np.full((3, 3), 1e-3), 1), "the rotation is not orthogonal"),
        (
            np.diag([1.0, np.nan, 1.0]),
            "the rotation is not orthogonal: R^T R differs from 1 by nan",
        ),
        (np.diag([1.0, np.inf, 1.0]), "the rotation is not orthogonal"),
    ],
)
def test_what_is_no_rotation_is_refused(matrix, message, coeffs):
    with pytest.raises(SettingsError) as caught:
        rotate_sh(coeffs, matrix)
    assert message in str(caught.value)
    with pytest.raises(SettingsError, match="the rotation is"):
        sh_rotation_matrix(4, matrix)


def test_one_bad_rotation_of_many_is_named(coeffs):
    rotations = np.tile(np.eye(3), (5, 1, 1))
    rotations[3, 0, 0] = -1.0
    with pytest.raises(SettingsError, match="rotation 3 is a reflection"):
        rotate_sh(coeffs, rotations)


@pytest.mark.parametrize("n", [0, 2, 24, 26])
def test_incomplete_coefficients_are_refused(n):
    with pytest.raises(SettingsError, match=f"{n} coefficients are no complete set"):
        rotate_sh(np.ones(n), np.eye(3))


@pytest.mark.parametrize(
    ("order", "condition", "n_kept", "kept_condition"),
    [(5, 1.517e5, 24, 3.229e3), (8, 3.465e9, 56, 3.041e4)],
)
def test_near_singular_gram_matrices(order, condition, n_kept, kept_condition):
    """Criterion: dropping may cost a signal of unit power 1e-4 of squared error."""
    whole, basis = HemisphereBasis(order, tolerance=0.0), HemisphereBasis(order)
    assert whole.n == order**2
    assert whole.condition == pytest.approx(condition, rel=1e-3)
    assert basis.n == n_kept
    assert basis.condition == pytest.approx(kept_condition, rel=1e-3)
    assert 0.0 < basis.drop_error <= 1e-4
    # the inverse of what is kept is one; of order 8 whole, float64 leaves seven digits
    gram = hemisphere_gram(order)[np.ix_(basis.kept, basis.kept)]
    np.testing.assert_allclose(basis.inverse_gram @ gram, np.eye(n_kept), rtol=0, atol=1e-11)


@pytest.mark.parametrize(("order", "worse"), [(5, 10.0), (8, 1e4)])
def test_float32_projections_survive_with_functions_dropped(order, worse, rng):
    """Rounding of b to float32: the full A^-1 blows coefficients up, the reduced one does not."""
    directions, weights = hemisphere_quadrature(12)
    signal = eval_sh(3, directions) @ rng.normal(size=9)
    b = eval_sh(order, directions).T @ (weights * signal)
    rounded = b.astype(np.float32).astype(np.float64)
    basis, whole = HemisphereBasis(order), HemisphereBasis(order, tolerance=0.0)
    off, off_whole = (
        np.abs(which.from_zero_hemisphere(rounded) - which.from_zero_hemisphere(b)).max()
        for which in (basis, whole)
    )
    assert off < 1e-2
    assert off_whole > worse * off
    fit = basis.evaluate(directions) @ basis.from_zero_hemisphere(rounded)
    assert weights @ (fit - signal) ** 2 < 1e-4 * (weights @ signal**2)


def test_order_10_whole_is_refused_and_says_what_works():
    with pytest.raises(SettingsError, match=r"100 functions of order 10 .* 3.1e\+12 .* 0.0001"):
        HemisphereBasis(10, tolerance=0.0)
    assert HemisphereBasis(10).condition < 2e4
