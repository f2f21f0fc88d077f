"""Pieces of a map's texels: against the cut itself."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.decode.transfer_basis import SphericalHarmonics
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.subdivision import subdivided_texels
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.planning.light_pieces import cut_texels, spacing_of


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
