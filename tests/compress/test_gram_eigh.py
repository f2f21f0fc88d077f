import numpy as np
import pytest

from prtbake_workers.compress.gram_eigh import (
    leading_eigenvectors,
    leading_row_space,
    nearer_row_space,
    orthonormal_rows,
)

# Eigenvectors of a float64 Gram matrix: 1e-16 over the smallest gap of these spectra, about 1e-3.
ATOL = 1e-11


def _with_spectrum(rng: np.random.Generator, shape: tuple[int, int], s: np.ndarray) -> np.ndarray:
    u = np.linalg.qr(rng.standard_normal((shape[0], len(s))))[0]
    v = np.linalg.qr(rng.standard_normal((shape[1], len(s))))[0]
    return (u * s) @ v.T


@pytest.mark.parametrize("shape", [(60, 20), (20, 60), (30, 30)])
def test_row_space_is_that_of_the_svd(shape: tuple[int, int], rng: np.random.Generator) -> None:
    matrix = _with_spectrum(rng, shape, 0.8 ** np.arange(15))
    basis = leading_row_space(matrix, 6)
    expected = np.linalg.svd(matrix)[2][:6]
    np.testing.assert_allclose(basis.T @ basis, expected.T @ expected, atol=ATOL)
    turned = expected.copy()
    turned[5] = np.linalg.svd(matrix)[2][6]
    assert not np.allclose(basis.T @ basis, turned.T @ turned, atol=ATOL)


@pytest.mark.parametrize("shape", [(60, 20), (20, 60)])
def test_rank_is_decided(shape: tuple[int, int], rng: np.random.Generator) -> None:
    exact = _with_spectrum(rng, shape, np.ones(5))
    assert leading_row_space(exact, 12).shape == (5, shape[1])
    in_float32 = exact.astype(np.float32).astype(np.float64)
    assert len(leading_row_space(in_float32, 12)) == 5
    noisy = exact + 1e-4 * rng.standard_normal(shape)
    assert len(leading_row_space(noisy, 12)) == 12


@pytest.mark.parametrize("shape", [(20, 60), (60, 20)])
def test_rows_stay_orthonormal_when_the_gram_matrix_is_nearly_singular(
    shape: tuple[int, int], rng: np.random.Generator
) -> None:
    matrix = _with_spectrum(rng, shape, np.logspace(0, -5.9, 20))
    basis = leading_row_space(matrix, 20)
    assert len(basis) == 20
    np.testing.assert_allclose(basis @ basis.T, np.eye(20), atol=1e-9)


def test_without_the_second_orthonormalisation_they_would_not(rng: np.random.Generator) -> None:
    matrix = _with_spectrum(rng, (20, 60), np.logspace(0, -5.9, 20))
    values, vectors = np.linalg.eigh(matrix @ matrix.T)
    rows = vectors.T @ matrix / np.sqrt(values)[:, None]
    assert not np.allclose(rows @ rows.T, np.eye(20), atol=1e-9)
    again = orthonormal_rows(rows)
    np.testing.assert_allclose(again @ again.T, np.eye(20), atol=1e-12)


@pytest.mark.parametrize("shape", [(4, 9), (9, 4), (0, 5)])
def test_zeros_have_no_row_space(shape: tuple[int, int]) -> None:
    assert leading_row_space(np.zeros(shape), 3).shape == (0, shape[1])


def test_eigenvectors_fall_and_equal_eigenvalues_stay_orthonormal(rng: np.random.Generator) -> None:
    q = np.linalg.qr(rng.standard_normal((30, 30)))[0]
    spectrum = np.repeat([4.0, 2.0, 1.0], 10)
    values, vectors = leading_eigenvectors((q * spectrum) @ q.T, 15)
    np.testing.assert_allclose(values, spectrum[:15], rtol=1e-12)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(15), atol=1e-9)
    assert leading_eigenvectors(np.eye(3), 8)[1].shape == (3, 3)


def test_an_iteration_holds_no_less_and_ends_at_the_leading_rows(rng):
    matrix = rng.standard_normal((40, 30)) * 0.8 ** np.arange(30)
    exact = leading_row_space(matrix, 5)
    best = np.linalg.norm(matrix @ exact.T)
    basis = np.linalg.qr(rng.standard_normal((30, 5)))[0].T
    held = [np.linalg.norm(matrix @ basis.T)]
    for _ in range(60):
        basis = nearer_row_space(matrix, basis)
        np.testing.assert_allclose(basis @ basis.T, np.eye(5), atol=1e-13)
        held.append(np.linalg.norm(matrix @ basis.T))
    assert (np.diff(held) > -1e-14 * best).all()
    assert held[1] > 1.1 * held[0]
    # the fifth and sixth singular values are about 0.8 apart: 0.8^(4 * 60) of what was missing
    assert held[-1] == pytest.approx(best, rel=1e-10)
    np.testing.assert_allclose(basis.T @ basis, exact.T @ exact, atol=1e-5)


@pytest.mark.parametrize("shape", [(3, 30), (40, 4)])
def test_a_matrix_of_few_rows_or_columns_keeps_what_it_has(shape, rng):
    matrix = rng.standard_normal(shape)
    start = np.linalg.qr(rng.standard_normal((shape[1], min(5, shape[1]))))[0].T
    basis = nearer_row_space(matrix, start)
    assert np.linalg.norm(matrix @ basis.T) == pytest.approx(np.linalg.norm(matrix), rel=1e-12)
