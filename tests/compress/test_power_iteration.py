import numpy as np
import pytest

from prtbake_workers.compress import gram_eigh, power_iteration
from prtbake_workers.compress.power_iteration import leading_eigenvectors, leading_row_space


def _with_spectrum(rng, shape, s):
    u = np.linalg.qr(rng.standard_normal((shape[0], len(s))))[0]
    v = np.linalg.qr(rng.standard_normal((shape[1], len(s))))[0]
    return (u * s) @ v.T


def _captured(matrix, basis):
    return np.sum((matrix @ basis.T) ** 2)


@pytest.mark.parametrize("shape", [(60, 20), (20, 60), (30, 30)])
def test_row_space_is_that_of_the_svd(rng, shape):
    matrix = _with_spectrum(rng, shape, 0.8 ** np.arange(15))
    basis = leading_row_space(matrix, 6)
    expected = np.linalg.svd(matrix)[2][:6]
    # CONVERGED over the smallest gap of the squares, 0.36
    np.testing.assert_allclose(basis.T @ basis, expected.T @ expected, atol=1e-8)
    np.testing.assert_allclose(np.abs(basis @ expected.T), np.eye(6), atol=1e-8)
    turned = expected.copy()
    turned[5] = np.linalg.svd(matrix)[2][6]
    assert not np.allclose(basis.T @ basis, turned.T @ turned, atol=1e-8)


@pytest.mark.parametrize("shape", [(60, 20), (20, 60)])
@pytest.mark.parametrize("spread", [0.0, 1e-12, 1e-6])
def test_of_repeated_singular_values_the_subspace_is_right(rng, shape, spread):
    """Vectors within a repeated value are anyone's; what they span together is not."""
    s = np.repeat([4.0, 2.0, 1.0], 4) * (1.0 + spread * rng.standard_normal(12))
    matrix = _with_spectrum(rng, shape, s)
    basis = leading_row_space(matrix, 8)
    expected = np.linalg.svd(matrix)[2][:8]
    np.testing.assert_allclose(basis @ basis.T, np.eye(8), atol=1e-9)
    np.testing.assert_allclose(basis.T @ basis, expected.T @ expected, atol=1e-8)
    # cut between two of them any choice takes as much, but for what they differ by
    s = np.sort(s)[::-1]
    assert _captured(matrix, basis[:6]) == pytest.approx(np.sum(s[:6] ** 2), rel=1e-8 + 4 * spread)


def test_close_values_that_do_not_converge_leave_the_rest_to_the_next_vector(rng, monkeypatch):
    monkeypatch.setattr(power_iteration, "MOST_ITERATIONS", 60)
    matrix = _with_spectrum(rng, (60, 20), np.array([1.0, 0.999, 0.998, 0.2, 0.1]))
    basis = leading_row_space(matrix, 3)
    expected = np.linalg.svd(matrix)[2][:3]
    np.testing.assert_allclose(basis.T @ basis, expected.T @ expected, atol=1e-8)
    np.testing.assert_allclose(np.abs(basis @ expected.T), np.eye(3), atol=1e-6)


@pytest.mark.parametrize("shape", [(60, 20), (20, 60)])
def test_rank_is_decided(rng, shape):
    exact = _with_spectrum(rng, shape, np.linspace(1.0, 2.0, 5))
    assert leading_row_space(exact, 12).shape == (5, shape[1])
    noisy = exact + 1e-4 * rng.standard_normal(shape)
    assert len(leading_row_space(noisy, 12)) == 12


@pytest.mark.parametrize("shape", [(4, 9), (9, 4), (0, 5)])
def test_zeros_have_no_row_space(shape):
    assert leading_row_space(np.zeros(shape), 3).shape == (0, shape[1])


def test_values_are_those_of_the_other_back_end_and_bytes_repeat(rng):
    matrix = rng.standard_normal((40, 12)) * 0.6 ** np.arange(12)
    gram = matrix.T @ matrix
    values, vectors = leading_eigenvectors(gram, 5)
    expected, _ = gram_eigh.leading_eigenvectors(gram, 5)
    np.testing.assert_allclose(values, expected, rtol=1e-12)
    np.testing.assert_allclose(gram @ vectors, vectors * values, atol=1e-8 * expected[0])
    again = leading_eigenvectors(gram, 5)[1]
    assert again.tobytes() == vectors.tobytes()
    assert leading_eigenvectors(np.eye(3), 8)[1].shape == (3, 3)
