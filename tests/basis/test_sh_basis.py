"""Spherical harmonics as a basis of transfer, against closed forms and dense sums."""

import numpy as np
import pytest

from prtbake_storage.decode.srbf import gaussian
from prtbake_storage.decode.transfer_basis import SphericalHarmonics, WhitenedSrbfs
from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.incident import (
    IncidentBasis,
    OrthonormalFunctions,
    basis_of,
    functions_from_tables,
)
from prtbake_workers.basis.projection import explained_energy
from prtbake_workers.basis.sh import eval_sh
from prtbake_workers.basis.sh_basis import ShBasis
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.transport.directions import cube_directions
from support.quadrature import sphere_quadrature

BANDS = np.array([np.pi, 2 * np.pi / 3, np.pi / 4, 0.0, -np.pi / 24])
"""Of max(0, cos), Ramamoorthi and Hanrahan 2001, eq. (8)."""
NORMAL = np.array([0.48, 0.6, 0.64])


@pytest.fixture(scope="module")
def cube():
    return cube_directions(16)


@pytest.fixture(scope="module")
def projection(cube):
    return ShBasis(5).projection(cube.directions, cube.weights)


def lambert(axis):
    degrees = np.repeat(np.arange(5), 2 * np.arange(5) + 1)
    return BANDS[degrees] / np.pi * eval_sh(5, axis[None])[0]


def test_an_unoccluded_lambert_vertex_has_the_closed_form(cube, projection):
    samples = np.maximum(0.0, cube.directions @ NORMAL) / np.pi
    # 2e-3 of the norm: the kink at the horizon between 16 x 16 texels a face, 2e-4 here
    tolerance = 2e-3 * np.linalg.norm(lambert(NORMAL))
    found = samples @ projection.matrix
    assert np.linalg.norm(found - lambert(NORMAL)) < tolerance
    # negative twin: another normal, by a degree
    other = np.array([0.48, 0.6 + 0.0175, 0.64]) / np.linalg.norm([0.48, 0.6175, 0.64])
    assert np.linalg.norm(found - lambert(other)) > 2 * tolerance


def test_the_residual_is_what_reconstruction_misses(cube, projection):
    samples = np.maximum(0.0, cube.directions @ NORMAL)[None, None] / np.pi
    coefficients = (samples @ projection.matrix).astype(np.float32)
    energy = np.einsum("vkd,d->v", samples**2, cube.weights)
    found = energy - explained_energy(coefficients, projection.rest.astype(np.float32))
    missed = samples[0, 0] - ShBasis(5).reconstruction_matrix(cube.directions) @ coefficients[0, 0]
    np.testing.assert_allclose(found, missed**2 @ cube.weights, rtol=1e-2)
    # Parseval: of |max(0, cos)|^2 = 2 pi / 3 the bands hold the sum of (2 l + 1) / 4 pi A_l^2
    held = ((2 * np.arange(5) + 1) / (4 * np.pi) * BANDS**2).sum() / (2 * np.pi / 3)
    assert found[0] / energy[0] == pytest.approx(1.0 - held, rel=0.05)
    # negative twin: sums weighted with solid angles, at texels too few to be orthonormal, leave
    # more than their energies say
    coarse, basis = cube_directions(3), ShBasis(5)
    tabled = basis.reconstruction_matrix(coarse.directions)
    few = np.maximum(0.0, coarse.directions @ NORMAL)
    summed = tabled.T @ (coarse.weights * few)
    said = (few**2) @ coarse.weights - summed @ summed
    left = (few - tabled @ summed) ** 2 @ coarse.weights
    assert abs(said - left) > 0.1 * left


def test_light_is_that_of_a_dense_sum_and_of_the_decoder():
    basis = ShBasis(6)
    directions, weights = sphere_quadrature(32)
    centre, lam, colour = NORMAL[None], np.array([9.0]), np.array([[1.0, 0.5, 2.0]])
    radiance = gaussian(directions @ centre.T, lam) @ colour
    found = basis.light_from_radiance(directions, weights, radiance)
    decoded = basis.stored.light_of_lobes(centre, lam, colour)
    np.testing.assert_allclose(found, decoded, atol=1e-12)
    assert np.abs(found - basis.stored.light_of_lobes(centre, 1.01 * lam, colour)).max() > 1e-3


@pytest.mark.parametrize("basis", [ShBasis(4), SrbfBasis(icosphere(0), 3.0)])
def test_either_kind_is_one_basis_to_bakes(basis, cube):
    assert isinstance(basis, IncidentBasis)
    assert isinstance(basis.functions, OrthonormalFunctions)
    again = basis_of(basis.stored)
    assert type(again) is type(basis)
    tabled = basis.functions.reconstruction_matrix(cube.directions)
    read = functions_from_tables(*basis.functions.tables())
    np.testing.assert_array_equal(read.reconstruction_matrix(cube.directions), tabled)
    np.testing.assert_allclose(again.functions.reconstruction_matrix(cube.directions), tabled)
    assert tabled.shape == (cube.n, basis.n)
    # orthonormal, and sampled densely enough for its narrowest function
    directions, weights = sphere_quadrature(32)
    tabled = basis.functions.reconstruction_matrix(directions)
    np.testing.assert_allclose(tabled.T * weights @ tabled, np.eye(basis.n), atol=1e-9)
    assert 0.0 < basis.spacing_rad < 0.2
    assert basis.condition >= 1.0


def test_an_order_out_of_range_is_refused():
    for order in (0, 101):
        with pytest.raises(SettingsError, match="sh_order is 1 to 100"):
            ShBasis(order)
    assert ShBasis(1).stored == SphericalHarmonics(1)
    assert isinstance(SrbfBasis(icosphere(0), 3.0).stored, WhitenedSrbfs)
