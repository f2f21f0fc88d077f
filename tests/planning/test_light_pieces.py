"""Pieces of a map's texels: against the cut itself."""

import numpy as np
import pytest

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.decode.transfer_basis import SphericalHarmonics
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import count_samples, fit_samples
from prtbake_workers.environment.procedural import one_texel_sun
from prtbake_workers.environment.sh_projection import sh_samples
from prtbake_workers.environment.subdivision import subdivided_texels
from prtbake_workers.environment.uniform_srbf import uniform_samples
from prtbake_workers.environment.wavelet_projection import wavelet_samples
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.planning.light_pieces import cut_texels, projected_pieces, spacing_of


@pytest.mark.parametrize("height", [4, 16, 64])
@pytest.mark.parametrize("finest", [0.02, 0.064, 0.5])
def test_pieces_are_those_that_a_map_is_cut_into(height, finest):
    environment = Environment(np.ones((height, 2 * height, 3), np.float32))
    directions, _, _ = subdivided_texels(environment, finest)
    assert cut_texels(2 * height**2, finest) == len(directions)


def test_spacing_is_that_of_the_basis():
    for settings, basis in (
        ({"n_centres": 162}, SrbfBasis(icosphere(2))),
        ({"n_centres": 42, "bandwidth": 9.0}, SrbfBasis(icosphere(1), 9.0)),
        ({"basis": "sh", "sh_order": 6}, SphericalHarmonics(6)),
    ):
        n_coeffs = basis.n if isinstance(basis, SrbfBasis) else basis.n_coeffs
        found = spacing_of(BakeSettings(**settings), n_coeffs)
        assert found == pytest.approx(basis.spacing_rad, rel=1e-12)


@pytest.mark.parametrize("rows", [7, 15])
def test_samples_of_a_fit_are_counted_as_they_are_made(rows):
    sun = one_texel_sun(32, sun_irradiance=9.0, sky_radiance=0.1)
    lamps = np.full((16, 32, 3), 0.1, np.float32)
    lamps[[0, 7, 12], [3, 20, 31]] = 90.0
    for environment in (sun, Environment(lamps), Environment(np.zeros((8, 16, 3), np.float32))):
        made = [len(cells.solid_angles) for cells in fit_samples(environment, rows)]
        assert list(count_samples(environment, rows)) == made
    # negative twin: the map's own texels are far fewer than what its lamps are split into
    assert made[0] == 128
    assert count_samples(Environment(lamps), rows)[2] > 10 * 512


def test_pieces_of_a_projection_are_counted_as_they_are_cut():
    environment = Environment(np.ones((16, 32, 3), np.float32))
    for settings, samples in (
        ({"method": "sh", "sh_order": 20}, sh_samples(environment, 20)),
        ({"method": "srbf_uniform", "n_centres": 162}, uniform_samples(environment, 162, None)),
        ({"method": "wavelet", "resolution": 16}, wavelet_samples(environment, 16)),
    ):
        settings = FitLightSettings(**settings)
        assert projected_pieces(settings, 512) == len(samples.solid_angles)
