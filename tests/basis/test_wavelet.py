"""Haar wavelets on a cube map against a matrix of functions written out one by one."""

import numpy as np
import pytest

from prtbake_storage.decode.cube_map import face_solid_angles
from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.wavelet import (
    haar,
    inverse_haar,
    largest_coefficients,
    support_areas,
)

N = 8


def areas_of(resolution):
    return np.tile(face_solid_angles(resolution).ravel(), 6)


def face_functions(resolution):
    """Every wavelet of one face as its radiance in every texel, by its place in the pyramid."""
    areas = face_solid_angles(resolution)
    functions = np.zeros((resolution, resolution, resolution, resolution))

    def mean(rows, columns):
        """A function of unit norm that is constant over a block."""
        values = np.zeros((resolution, resolution))
        values[rows, columns] = 1.0 / np.sqrt(areas[rows, columns].sum())
        return values

    def difference(first, second):
        """Orthonormal to the mean over both, from the functions of unit norm of the halves."""
        a, b = (areas[f > 0].sum() for f in (first, second))
        return (np.sqrt(a) * second - np.sqrt(b) * first) / np.sqrt(a + b)

    edge = resolution
    while edge > 1:
        size = resolution // edge
        for i in range(edge // 2):
            for j in range(edge // 2):
                top = slice(2 * i * size, (2 * i + 1) * size)
                bottom = slice((2 * i + 1) * size, (2 * i + 2) * size)
                left = slice(2 * j * size, (2 * j + 1) * size)
                right = slice((2 * j + 1) * size, (2 * j + 2) * size)
                both = slice(left.start, right.stop)
                functions[edge // 2 + i, j] = difference(mean(top, both), mean(bottom, both))
                upper = difference(mean(top, left), mean(top, right))
                lower = difference(mean(bottom, left), mean(bottom, right))
                a, b = areas[top, both].sum(), areas[bottom, both].sum()
                functions[i, edge // 2 + j] = (np.sqrt(a) * upper + np.sqrt(b) * lower) / np.sqrt(
                    a + b
                )
                functions[edge // 2 + i, edge // 2 + j] = (
                    np.sqrt(a) * lower - np.sqrt(b) * upper
                ) / np.sqrt(a + b)
        edge //= 2
    functions[0, 0] = mean(slice(None), slice(None))
    return functions.reshape(resolution**2, resolution**2)


def test_coefficients_are_integrals_with_orthonormal_functions(rng):
    functions = face_functions(N)
    areas = face_solid_angles(N).ravel()
    gram = (functions * areas) @ functions.T
    np.testing.assert_allclose(gram, np.eye(N * N), atol=1e-13)
    radiance = rng.random((6 * N * N, 3))
    expected = np.einsum("kt,t,ftc->fkc", functions, areas, radiance.reshape(6, -1, 3))
    np.testing.assert_allclose(haar(radiance, N), expected.reshape(-1, 3), atol=1e-13)
    # negative twin: texels of equal weight are another basis
    plain = np.einsum("kt,ftc->fkc", functions, radiance.reshape(6, -1, 3)) * areas.mean()
    assert np.abs(plain - expected).max() > 1e-3


@pytest.mark.parametrize("resolution", [1, 2, 16])
def test_the_inverse_undoes_and_products_are_integrals(rng, resolution):
    first, second = rng.normal(size=(2, 6 * resolution**2, 2))
    a, b = haar(first, resolution), haar(second, resolution)
    np.testing.assert_allclose(inverse_haar(a, resolution), first, rtol=0, atol=1e-12)
    integral = (areas_of(resolution)[:, None] * first * second).sum(axis=0)
    np.testing.assert_allclose((a * b).sum(axis=0), integral, rtol=0, atol=1e-12)


def test_texels_of_equal_weight_are_another_product(rng):
    first, second = rng.normal(size=(2, 6 * N * N, 1))
    product = float((haar(first, N) * haar(second, N)).sum())
    assert abs(float((first * second).mean()) * 4 * np.pi - product) > 1e-3


def test_a_constant_has_one_coefficient_a_face():
    coefficients = haar(np.full((6 * N * N, 1), 2.0), N).reshape(6, -1)
    assert coefficients[:, 0] == pytest.approx(2.0 * np.sqrt(4 * np.pi / 6))
    assert np.abs(coefficients[:, 1:]).max() < 1e-14


def test_what_is_dropped_is_the_error_and_no_other_choice_leaves_less(rng):
    radiance = rng.random((6 * N * N, 3)) ** 6
    coefficients = haar(radiance, N)
    kept = largest_coefficients(coefficients, 40)
    assert (np.diff(kept) > 0).all()

    def error(chosen):
        some = np.zeros_like(coefficients)
        some[chosen] = coefficients[chosen]
        left = radiance - inverse_haar(some, N)
        return float(areas_of(N) @ (left**2).sum(axis=1))

    dropped = np.delete(coefficients, kept, axis=0)
    assert error(kept) == pytest.approx((dropped**2).sum(), rel=1e-12)
    for _ in range(5):
        other = kept.copy()
        other[rng.integers(40)] = rng.choice(np.delete(np.arange(len(radiance)), kept))
        assert error(other) > error(kept)


def test_areas_are_those_of_the_functions_supports(rng):
    functions, areas = face_functions(N), face_solid_angles(N).ravel()
    expected = (np.abs(functions) > 0) @ areas
    np.testing.assert_allclose(support_areas(N), np.tile(expected, 6), rtol=1e-13)
    # weighted by them a wide dim square goes before a bright texel
    radiance = np.zeros((6 * N * N, 1))
    radiance[0] = 60.0
    radiance[N * N : 2 * N * N] = 1.0
    coefficients = haar(radiance, N)
    (brightest,) = largest_coefficients(coefficients, 1)
    (widest,) = largest_coefficients(coefficients, 1, support_areas(N))
    assert brightest < N * N
    assert widest == N * N


def test_zeros_are_not_kept():
    coefficients = haar(np.ones((6 * N * N, 3)), N)
    assert (
        len(largest_coefficients(np.where(np.abs(coefficients) < 1e-12, 0.0, coefficients), 50))
        == 6
    )
    assert largest_coefficients(np.zeros((24, 3)), 5).tolist() == [0]


@pytest.mark.parametrize("n_kept", [0, 25])
def test_impossible_numbers_are_refused(n_kept):
    with pytest.raises(SettingsError, match=f"not {n_kept}"):
        largest_coefficients(np.ones((24, 3)), n_kept)


@pytest.mark.parametrize("resolution", [0, 3, 1024])
def test_resolutions_that_cannot_be_halved_are_refused(resolution):
    with pytest.raises(ValueError, match=f"resolution is {resolution}"):
        haar(np.zeros((6, 3)), resolution)
