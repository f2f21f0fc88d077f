"""Spherical harmonics against scipy, hand-written polynomials and exact quadrature."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import sph_harm_y

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.sh import eval_sh
from support.quadrature import random_directions, sphere_quadrature

AXES = np.concatenate([np.eye(3), -np.eye(3)])


def degrees_and_orders(order):
    degrees = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    return degrees, np.arange(order**2) - degrees * (degrees + 1)


def from_scipy(order, directions, *, phase=False):
    """Real and imaginary parts of scipy's complex functions, which carry (-1)^m."""
    x, y, z = directions.T[:, :, None]
    degrees, m = degrees_and_orders(order)
    values = sph_harm_y(degrees, np.abs(m), np.arctan2(np.hypot(x, y), z), np.arctan2(y, x))
    values = np.where(m == 0, values.real, np.sqrt(2) * np.where(m > 0, values.real, values.imag))
    return values if phase else values * (-1.0) ** m


def near_poles(rng, n):
    sine = np.logspace(-12, -1, n)
    phi = rng.uniform(0, 2 * np.pi, n)
    z = np.sqrt(1 - sine**2) * rng.choice([-1.0, 1.0], n)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), z], axis=1)


@pytest.mark.parametrize("order", [1, 2, 3, 10, 100])
def test_equal_to_scipy(order, rng):
    directions = np.concatenate([AXES, random_directions(rng, 12), near_poles(rng, 6)])
    values = eval_sh(order, directions)
    assert values.shape == (len(directions), order**2)
    # rounding of z counts l^2 / 2 times, and the norm, at the poles: 2.6e-12 measured at order 100
    tolerance = 5e-16 * order**2
    np.testing.assert_allclose(values, from_scipy(order, directions), rtol=0, atol=tolerance)
    if order > 1:  # negative twin: with the Condon-Shortley phase
        assert np.abs(values - from_scipy(order, directions, phase=True)).max() > 0.1


def test_first_three_degrees_by_hand(rng):
    directions = random_directions(rng, 20)
    x, y, z = directions.T
    c = np.sqrt(1 / np.pi)
    by_hand = [
        c / 2 + 0 * z,
        np.sqrt(3) / 2 * c * y, np.sqrt(3) / 2 * c * z, np.sqrt(3) / 2 * c * x,
        np.sqrt(15) / 2 * c * x * y, np.sqrt(15) / 2 * c * y * z,
        np.sqrt(5) / 4 * c * (3 * z * z - 1),
        np.sqrt(15) / 2 * c * x * z, np.sqrt(15) / 4 * c * (x * x - y * y),
    ]  # fmt: skip
    np.testing.assert_allclose(eval_sh(3, directions), np.stack(by_hand, axis=1), atol=1e-15)


def test_orthonormal_by_exact_quadrature():
    order = 16
    directions, weights = sphere_quadrature(order)  # exact up to degree 2 order - 1
    values = eval_sh(order, directions)
    gram = values.T @ (weights[:, None] * values)
    np.testing.assert_allclose(gram, np.eye(order**2), rtol=0, atol=1e-13)
    # negative twin: a rule of one point fewer a meridian is no longer exact
    directions, weights = sphere_quadrature(order - 1)
    values = eval_sh(order, directions)
    assert np.abs(values.T @ (weights[:, None] * values) - np.eye(order**2)).max() > 0.1


def test_addition_theorem_at_order_100(rng):
    """The squares of a degree sum to (2 l + 1) / (4 pi) in every direction."""
    directions = np.concatenate([AXES, random_directions(rng, 50), near_poles(rng, 50)])
    degrees = np.arange(100)
    sums = np.add.reduceat(eval_sh(100, directions) ** 2, degrees**2, axis=1)
    np.testing.assert_allclose(sums, np.tile((2 * degrees + 1) / (4 * np.pi), (106, 1)), rtol=5e-12)


@settings(deadline=None, max_examples=50)
@given(
    st.integers(1, 40),
    st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda d: np.linalg.norm(d) > 1e-3),
)
def test_parities_in_every_axis(order, direction):
    d = np.array([direction]) / np.linalg.norm(direction)
    values = eval_sh(order, d)
    degrees, m = degrees_and_orders(order)
    sine = np.where(m < 0, -1.0, 1.0)
    # reflections change signs only; turning about z by pi too
    for signs, parity in [
        ([-1, -1, -1], (-1.0) ** degrees),
        ([1, 1, -1], (-1.0) ** (degrees + m)),
        ([1, -1, 1], sine),
        ([-1, 1, 1], sine * (-1.0) ** m),
    ]:
        mirrored = eval_sh(order, d * np.array(signs, dtype=float))
        np.testing.assert_allclose(mirrored, parity * values, rtol=0, atol=1e-14)


def test_blocks_of_directions_do_not_show(rng):
    directions = random_directions(rng, 3000)
    whole = eval_sh(20, directions)
    np.testing.assert_array_equal(whole[::500], eval_sh(20, directions[::500]))
    assert eval_sh(4, directions[:0]).shape == (0, 16)


def test_lengths_of_float32_are_taken_out(rng):
    exact = random_directions(rng, 50)
    rounded = exact.astype(np.float32).astype(np.float64)
    unit = rounded / np.linalg.norm(rounded, axis=1, keepdims=True)
    np.testing.assert_allclose(eval_sh(30, rounded), eval_sh(30, unit), rtol=0, atol=1e-13)


@pytest.mark.parametrize("bad", [[0.0, 0.0, 0.0], [0.0, 0.0, 1.001], [np.nan, 0.0, 1.0]])
def test_what_is_no_unit_vector_is_refused_by_its_row(bad, rng):
    directions = random_directions(rng, 5)
    directions[3] = bad
    with pytest.raises(SettingsError, match="direction 3 is no unit vector: length"):
        eval_sh(4, directions)


def test_order_below_one_is_refused():
    with pytest.raises(SettingsError, match="at least 1, got 0"):
        eval_sh(0, np.eye(3))
