"""Wavelet compression: exact with all coefficients, and its error that of what comes back."""

import numpy as np
import pytest

from prtbake_storage.decode.cube_map import face_solid_angles
from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.baselines.wavelet_transfer import compress_wavelets

N_TEXELS = 96


def squared_error(model, transfer, weights):
    difference = transfer.astype(float) - model.reconstruct()
    return float(weights @ np.einsum("vkt,vkt->v", difference, difference))


def test_all_wavelets_are_the_signal(sampled):
    model = compress_wavelets(sampled, sampled.size)
    # one rounding of coefficients of up to 10 to float32
    np.testing.assert_allclose(model.reconstruct(), sampled, rtol=0, atol=5e-6)
    assert model.squared_error_ratio < 1e-12


def test_wavelet_error_is_that_of_what_is_reconstructed(sampled):
    weights = np.where(np.arange(80) < 20, 9.0, 1.0)
    model = compress_wavelets(sampled, 900, vertex_weights=weights)
    error = squared_error(model, sampled, weights)
    assert model.objective[-1] == pytest.approx(error, rel=1e-5)
    assert 0.01 < model.squared_error_ratio < 0.9
    np.testing.assert_allclose(
        model.reconstruct(slice(5, 9)), model.reconstruct()[5:9], rtol=0, atol=1e-6
    )
    assert model.nbytes == 6 * 900 + 2 * 80 * 4
    # the negative twin: the faces in another order
    moved = np.roll(model.reconstruct(), 16, axis=2)
    assert np.sum((sampled - moved) ** 2) > 1.3 * np.sum((sampled - model.reconstruct()) ** 2)


def test_a_constant_is_one_wavelet_a_face():
    roots = np.sqrt(face_solid_angles(4)).reshape(1, 1, 16)
    constant = np.tile(roots, (3, 2, 6)).astype(np.float32)
    model = compress_wavelets(constant, 3 * 2 * 6)
    np.testing.assert_allclose(model.reconstruct(), constant, rtol=1e-6)
    assert compress_wavelets(constant, 3 * 2 * 6 - 1).squared_error_ratio == pytest.approx(1 / 36)


def test_wavelets_are_the_largest_of_a_matrix_written_out(sampled):
    """The slow twin: the transform as a matrix, of one unit texel after another."""
    columns = [compress_wavelets(unit, 96).kept.reconstruct()[0, 0] for unit in _units()]
    matrix = np.array(columns, dtype=float)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(N_TEXELS), atol=1e-6)
    scores = np.sort(((sampled.astype(float) @ matrix) ** 2).ravel())
    model = compress_wavelets(sampled, 400)
    assert model.objective[-1] == pytest.approx(scores[:-400].sum(), rel=1e-5)


def _units():
    return [row.reshape(1, 1, -1) for row in np.eye(N_TEXELS, dtype=np.float32)]


@pytest.mark.parametrize("n_texels", [95, 54])
def test_texels_that_are_no_cube_map_are_refused(n_texels):
    with pytest.raises(SettingsError, match=f"{n_texels} texels"):
        compress_wavelets(np.ones((2, 1, n_texels), np.float32), 3)
