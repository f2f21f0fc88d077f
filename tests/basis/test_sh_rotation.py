"""Rotation against re-projection by exact quadrature, against evaluation, and as a group."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from prtbake_workers.basis.quarter_turn import quarter_turns
from prtbake_workers.basis.sh import eval_sh, rotate_sh, sh_rotation_matrix
from prtbake_workers.basis.sh_rotation import zyz_angles
from support.quadrature import random_directions, sphere_quadrature


def random_rotations(rng, n):
    return Rotation.random(n, rng=rng).as_matrix()


def reprojected(coeffs, rotations):
    """f(R^T d) at the points of an exact quadrature, projected: the oracle."""
    order = round(coeffs.shape[-1] ** 0.5)
    directions, weights = sphere_quadrature(order)
    project = weights[:, None] * eval_sh(order, directions)
    turned = directions @ rotations  # R^T d by rows
    values = eval_sh(order, turned.reshape(-1, 3)).reshape(*turned.shape[:2], -1)
    return (values @ coeffs[:, :, None])[..., 0] @ project


@pytest.mark.parametrize("order", range(1, 11))
def test_1000_random_rotations_equal_reprojection(order, rng):
    worst = off = 0.0
    for _ in range(10):  # tables of 100 rotations at a time
        rotations = random_rotations(rng, 100)
        coeffs = rng.normal(size=(100, order**2))
        expected = reprojected(coeffs, rotations)
        worst = max(worst, np.abs(rotate_sh(coeffs, rotations) - expected).max())
        inverse = np.swapaxes(rotations, 1, 2)
        off = max(off, np.abs(rotate_sh(coeffs, inverse) - expected).max())
    assert worst < 1e-12  # rounding; the claim is 1e-10
    assert (off > 0.1) == (order > 1)  # negative twin: the inverse rotation


@pytest.mark.parametrize("order", [40, 100])
def test_rotated_function_at_high_order(order, rng):
    rotation = random_rotations(rng, 1)[0]
    coeffs = rng.normal(size=order**2) / order
    directions = random_directions(rng, 40)
    expected = eval_sh(order, directions @ rotation) @ coeffs
    # 1e-11: 1e-13 of each of the 10,000 summands, at random
    np.testing.assert_allclose(
        eval_sh(order, directions) @ rotate_sh(coeffs, rotation), expected, rtol=0, atol=1e-11
    )


def test_leading_axes_broadcast(rng):
    rotations = random_rotations(rng, 5)
    coeffs = rng.normal(size=(5, 3, 36))
    each = rotate_sh(coeffs, rotations[:, None])
    assert each.shape == coeffs.shape
    for i, rotation in enumerate(rotations):
        # one row and many take other products: equal to rounding
        np.testing.assert_allclose(each[i], rotate_sh(coeffs[i], rotation), atol=1e-14)
        np.testing.assert_allclose(each[i, 2], rotate_sh(coeffs[i, 2], rotation), atol=1e-14)
    same = rotate_sh(np.broadcast_to(coeffs[0, 0], (40, 36)), rotations[0])
    np.testing.assert_allclose(same, np.tile(each[0, 0], (40, 1)), atol=1e-14)
    assert rotate_sh(coeffs[0, 0], rotations).shape == (5, 36)
    assert rotate_sh(np.zeros((0, 9)), rotations[0]).shape == (0, 9)
    assert rotate_sh(np.zeros((0, 9)), np.zeros((0, 3, 3))).shape == (0, 9)


def test_input_is_left_alone(rng):
    coeffs, rotation = rng.normal(size=25), random_rotations(rng, 1)[0]
    before = coeffs.copy(), rotation.copy()
    rotate_sh(coeffs, rotation)
    np.testing.assert_array_equal(coeffs, before[0])
    np.testing.assert_array_equal(rotation, before[1])


def test_matrix_is_the_rotation(rng):
    rotations = random_rotations(rng, 3)
    coeffs = rng.normal(size=49)
    matrices = sh_rotation_matrix(7, rotations)
    assert matrices.shape == (3, 49, 49)
    np.testing.assert_allclose(matrices @ coeffs, rotate_sh(coeffs, rotations), atol=1e-14)
    np.testing.assert_allclose(
        matrices @ np.swapaxes(matrices, 1, 2), np.tile(np.eye(49), (3, 1, 1)), atol=1e-14
    )
    degrees = np.repeat(np.arange(7), 2 * np.arange(7) + 1)
    mixed = degrees[:, None] != degrees
    assert not matrices[:, mixed].any()
    # degree 1 holds y, z, x
    np.testing.assert_allclose(
        matrices[:, 1:4, 1:4], rotations[:, [1, 2, 0]][:, :, [1, 2, 0]], atol=1e-15
    )


def test_matrices_multiply_as_rotations_do(rng):
    r, s = random_rotations(rng, 2)
    product = sh_rotation_matrix(12, r) @ sh_rotation_matrix(12, s)
    np.testing.assert_allclose(sh_rotation_matrix(12, r @ s), product, rtol=0, atol=1e-13)
    assert np.abs(sh_rotation_matrix(12, s @ r) - product).max() > 0.1


def test_quarter_turns_are_orthogonal_to_order_100():
    for degree, turn in enumerate(quarter_turns(100)):
        real = np.delete(np.arange(2 * degree + 2), 1)  # sin 0 is no function
        q = turn[np.ix_(real, real)]
        # 2e-15: rounding of the product itself, 6e-16 measured
        np.testing.assert_allclose(q @ q.T, np.eye(2 * degree + 1), rtol=0, atol=2e-15)
        assert not turn[1].any()
        assert not turn[:, 1].any()


@pytest.mark.parametrize("degree", [1, 6, 30])
def test_quarter_turns_equal_reprojection(degree):
    """z becomes x: y_lm at R^T d, integrated against every function of the degree."""
    directions, weights = sphere_quadrature(degree + 1)
    functions = slice(degree**2, (degree + 1) ** 2)
    turned = directions @ rotation_y(np.pi / 2)
    matrix = (weights[:, None] * eval_sh(degree + 1, directions)[:, functions]).T
    matrix = matrix @ eval_sh(degree + 1, turned)[:, functions]
    m = np.arange(degree + 1)
    parts = np.stack([degree + m, degree - m], axis=1).ravel()
    expected = matrix[np.ix_(parts, parts)]
    expected[1] = expected[:, 1] = 0.0
    quarter = quarter_turns(degree + 1)[degree]
    np.testing.assert_allclose(quarter, expected, rtol=0, atol=1e-13)
    assert np.abs(quarter.T - expected).max() > 0.1  # negative twin: the turn back


def rotation_z(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def rotation_y(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


ANGLES = st.floats(-np.pi, np.pi) | st.sampled_from([0.0, 1e-300, 1e-16, 1e-12, 1e-8, np.pi])


@settings(deadline=None)
@given(ANGLES, ANGLES, ANGLES)
def test_angles_give_the_rotation_back(a, b, c):
    rotation = rotation_z(a) @ rotation_y(b) @ rotation_z(c)
    a2, b2, c2 = zyz_angles(rotation.ravel().tolist())
    again = rotation_z(a2) @ rotation_y(b2) @ rotation_z(c2)
    np.testing.assert_allclose(again, rotation, rtol=0, atol=1e-15)
