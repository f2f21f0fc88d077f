"""Regularised least squares on an orthonormal basis."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.projection import RIDGE, explained_energy, project
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.transport.directions import cube_directions


@pytest.fixture(scope="module")
def basis():
    return SrbfBasis(icosphere(2))


@pytest.fixture(scope="module")
def cube():
    return cube_directions(16)


@pytest.fixture(scope="module")
def projection(basis, cube):
    return basis.projection(cube.directions, cube.weights)


def occluded_lobes(cube, rng, n):
    normals, blockers = rng.normal(size=(2, n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seen = blockers @ cube.directions.T > 0.0
    return np.maximum(0.0, normals @ cube.directions.T) / np.pi * seen


def test_matrix_minimises_the_stated_objective(projection, cube, rng):
    """Against numpy's least squares on the stacked problem (samples, then the ridge)."""
    samples = occluded_lobes(cube, rng, 3)
    root = np.sqrt(cube.weights)[:, None]
    stacked = np.concatenate([root * projection.samples, np.sqrt(RIDGE) * np.eye(162)])
    target = np.concatenate([root * samples.T, np.zeros((162, 3))])
    expected = np.linalg.lstsq(stacked, target, rcond=None)[0].T
    np.testing.assert_allclose(samples @ projection.matrix, expected, rtol=0, atol=1e-11)
    unweighted = np.linalg.lstsq(projection.samples, samples.T, rcond=None)[0].T
    assert np.abs(unweighted - expected).max() > 1e-4


def test_residual_energy_equals_reconstruction(projection, cube, rng):
    samples = occluded_lobes(cube, rng, 12).reshape(4, 3, -1)
    energy = (samples**2 @ cube.weights).sum(axis=1)
    fit = (samples @ projection.matrix).astype(np.float32)
    direct = projection.residual_energy_direct(samples, fit)
    # 1e-6 of the energy: rounding of the float32 coefficients
    np.testing.assert_allclose(
        energy - explained_energy(fit, projection.rest.astype(np.float32)),
        direct,
        rtol=0,
        atol=1e-6 * energy.max(),
    )
    # negative twins: without the directions' own Gram matrix, and with another fit
    plain = energy - (fit.astype(np.float64) ** 2).sum(axis=(1, 2))
    assert np.abs(plain - direct).max() > 1e-5 * energy.max()
    assert (projection.residual_energy_direct(samples, 0.99 * fit) > direct).all()


def test_unoccluded_lobe_equals_its_closed_form(basis, projection, cube):
    """A cosine lobe against one Gaussian: a one-dimensional integral, done by quadrature.

    The whitened coefficients are G^(-1/2) b with b_j = integral of lobe x Gaussian; by symmetry b
    depends on the angle between normal and centre alone.
    """
    normal = np.array([0.0, 0.6, 0.8])
    nodes, weights = np.polynomial.legendre.leggauss(64)
    z, wz = 0.5 * (nodes + 1.0), 0.5 * weights  # the upper hemisphere
    azimuth = 2 * np.pi * (np.arange(256) + 0.5) / 256
    cosines = basis.centres @ normal
    sines = np.sqrt(1 - cosines**2)
    aligned = cosines[:, None, None] * z[None, :, None] + sines[:, None, None] * np.sqrt(1 - z**2)[
        None, :, None
    ] * np.cos(azimuth)
    b = np.exp(basis.bandwidth * (aligned - 1.0)).sum(axis=2) * (2 * np.pi / 256)
    expected = basis.whitening.inv_sqrt_gram @ (b @ (wz * z / np.pi))
    fit = np.maximum(0.0, cube.directions @ normal) / np.pi @ projection.matrix
    # 1 %: the quadrature over 16 x 16 texels a face is of second order
    assert np.linalg.norm(fit - expected) < 0.01 * np.linalg.norm(expected)
    off = np.maximum(0.0, cube.directions @ [0.0, 0.8, 0.6]) / np.pi @ projection.matrix
    assert np.linalg.norm(off - expected) > 0.1 * np.linalg.norm(expected)


def test_the_directions_resolve_the_basis(projection):
    assert projection.gram_defect < 0.01


def test_bad_weights_and_ridge_are_refused(basis, cube):
    with pytest.raises(SettingsError, match="must sum to 4 pi"):
        basis.projection(cube.directions, 1.01 * cube.weights)
    with pytest.raises(SettingsError, match="ridge must be positive"):
        project(basis.reconstruction_matrix(cube.directions), cube.weights, ridge=0.0)
