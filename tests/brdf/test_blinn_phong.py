import numpy as np
import pytest

from prtbake_workers.brdf.blinn_phong import BlinnPhong
from prtbake_workers.brdf.checks import directional_albedo

GREY = np.array([0.0])
ONE = np.array([1.0])


@pytest.mark.parametrize("exponent", [1.0, 10.0, 100.0, 1e4])
def test_albedo_at_normal_view_is_ks(exponent):
    got = directional_albedo(BlinnPhong(GREY, np.array([0.7]), exponent), ONE)
    # 8 Gauss nodes a panel resolve the sharpest lobe to this
    np.testing.assert_allclose(got, 0.7, rtol=1e-9)


def test_the_usual_factor_would_not_do():
    """Twin: (n + 8) / (8 pi) is 5.3 % off at n = 1, so the test above tells them apart."""
    exact = BlinnPhong(GREY, ONE, 1.0).eval_brdf(np.array([[0, 0, 1.0]]), np.array([[0, 0, 1.0]]))
    assert abs(exact[0, 0] * 8 * np.pi / 9.0 - 1) > 0.01


def test_lobe_follows_the_half_vector():
    lobe = BlinnPhong(GREY, ONE, 30.0)
    wi, wo = np.array([[0.6, 0.0, 0.8]]), np.array([[0.0, 0.6, 0.8]])
    h = (wi + wo) / np.linalg.norm(wi + wo)
    peak = lobe.eval_brdf(wi, wi * np.array([-1.0, 1.0, 1.0]))
    np.testing.assert_allclose(lobe.eval_brdf(wi, wo) / peak, h[0, 2] ** 30, rtol=1e-12)
