import numpy as np
import pytest

from prtbake_workers.brdf.checks import directional_albedo
from prtbake_workers.brdf.phong import Phong

GREY = np.array([0.0])
ONE = np.array([1.0])


@pytest.mark.parametrize("exponent", [1.0, 10.0, 200.0, 1e4])
def test_albedo_at_normal_view_is_ks(exponent):
    """(n + 2) / (2 pi) times the integral of cos^(n + 1) over the hemisphere is 1."""
    got = directional_albedo(Phong(GREY, np.array([0.7]), exponent), ONE)
    # 8 Gauss nodes a panel resolve the sharpest lobe to this
    np.testing.assert_allclose(got, 0.7, rtol=1e-9)
    # twin: the (n + 1) / (2 pi) of an un-projected lobe fails
    wrong = got * (exponent + 1) / (exponent + 2)
    assert abs(wrong[0, 0] / 0.7 - 1) > 1e-5


def test_albedo_at_grazing_view_is_half_a_lobe():
    """With the lobe's axis in the plane, cos_r = cos a and cos_o = sin a sin b.

    The integral of cos^n(a) sin(a) sin(b) sin(a) da db over a quarter sphere is
    B(3 / 2, (n + 1) / 2).
    """
    from scipy.special import beta

    n = 10.0
    got = directional_albedo(Phong(GREY, ONE, n), np.array([1e-6]))
    # the light stands 1e-6 above the horizon, not on it
    np.testing.assert_allclose(got[0, 0], (n + 2) / (2 * np.pi) * beta(1.5, (n + 1) / 2), rtol=1e-4)


def test_peak_lies_in_the_mirror_direction():
    phong = Phong(GREY, ONE, 50.0)
    wi = np.array([[0.6, 0.0, 0.8]])
    mirror, other = np.array([[-0.6, 0.0, 0.8]]), np.array([[0.6, 0.0, 0.8]])
    np.testing.assert_allclose(phong.eval_brdf(wi, mirror), 52 / (2 * np.pi))
    assert phong.eval_brdf(wi, other)[0, 0] < 1e-20
