"""Distances to mirror images, for a grain that lies askew."""

import numpy as np
import pytest

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.mirrors import MIRRORS, MOST_ASYMMETRY, Mirrored, check_mirrors
from prtbake_workers.brdf.ward import Ward

WARD = Ward(np.full(1, 0.2), np.full(1, 0.6), 0.1, 0.4)


class Turned:
    """Ward, turned about the normal."""

    n_channels = 1
    is_isotropic = False

    def __init__(self, degrees):
        c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
        self.turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def eval_brdf(self, wi, wo):
        return WARD.eval_brdf(wi @ self.turn, wo @ self.turn)


def test_an_upright_grain_is_its_own_mirror_image():
    assert check_mirrors(WARD) == 0.0


def test_the_mirror_image_of_a_turned_grain_is_turned_the_other_way(directions):
    wi, wo = directions(100), directions(100, seed=2)
    for mirror in MIRRORS.values():
        np.testing.assert_allclose(
            Mirrored(Turned(15.0), mirror).eval_brdf(wi, wo),
            Turned(-15.0).eval_brdf(wi, wo),
            rtol=1e-12,
        )


def test_a_grain_a_little_askew_is_measured_and_more_is_refused():
    one, two = (check_mirrors(Turned(degrees)) for degrees in (1.0, 2.0))
    assert 0.0 < one < two < MOST_ASYMMETRY
    # the distance between a BRDF and its neighbour goes by the angle between
    assert two == pytest.approx(2.0 * one, rel=0.05)
    with pytest.raises(BrdfError, match=r"about its \w+: .* by 28 % .* at most 20 %"):
        check_mirrors(Turned(5.0))
    # twin: a whole turn is none
    assert check_mirrors(Turned(360.0)) < 1e-9
