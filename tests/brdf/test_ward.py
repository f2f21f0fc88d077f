import numpy as np
import pytest
from scipy.integrate import dblquad

from prtbake_workers.brdf.base import above_horizon, clamped_cosines
from prtbake_workers.brdf.checks import directional_albedo
from prtbake_workers.brdf.cook_torrance import beckmann
from prtbake_workers.brdf.ward import Ward

GREY = np.array([0.0])
ONE = np.array([1.0])


class OtherForm:
    """Ward's own form (power 1/2 of the cosines), or Duer's (power 1)."""

    n_channels = 1

    def __init__(self, alpha, power):
        self.alpha, self.power = alpha, power

    def eval_brdf(self, wi, wo):
        h = wi + wo
        tan2 = (h[..., 0] ** 2 + h[..., 1] ** 2) / np.maximum(h[..., 2], 1e-6) ** 2
        cos_i, cos_o = clamped_cosines(wi, wo)
        lobe = np.exp(-tan2 / self.alpha**2) / (4 * np.pi * self.alpha**2)
        lobe = lobe / (cos_i * cos_o) ** self.power
        return np.where(above_horizon(wi, wo), lobe, 0.0)[..., None]


@pytest.mark.parametrize("alpha", [0.01, 0.2, 1.0])
def test_albedo_at_normal_light_is_a_closed_form(alpha):
    """Over slopes t = tan theta_h up to 1: 2 / a^2 times the integral of exp(-t^2 / a^2) t (1 - t^2)."""
    got = directional_albedo(Ward(GREY, ONE, alpha, alpha), ONE)[0, 0]
    np.testing.assert_allclose(got, 1 - alpha**2 * -np.expm1(-1 / alpha**2), rtol=1e-9)


def test_albedo_of_unequal_slopes_at_normal_light():
    ax, ay = 0.4, 0.1

    def slopes(y, x):
        density = np.exp(-((x / ax) ** 2) - (y / ay) ** 2) / (np.pi * ax * ay)
        return density * max(0.0, 1 - x * x - y * y)

    plain = 4 * dblquad(slopes, 0, 1, 0, 0.8, epsabs=1e-10)[0]
    got = directional_albedo(Ward(GREY, ONE, ax, ay), ONE)[0, 0]
    assert got == pytest.approx(plain, rel=1e-7)  # the kink of max(0, ...) in the twin
    same = directional_albedo(Ward(GREY, ONE, ax, ax), ONE)[0, 0]
    assert abs(same / plain - 1) > 1e-2


def test_the_lobe_is_beckmann_over_four_cos_d_squared(directions):
    wi, wo = directions(200), directions(200, seed=2)
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    cos_d = np.sum(wi * h, axis=-1)
    plain = beckmann(h[:, 2], 1 - h[:, 2] ** 2, 0.3) / (4 * cos_d**2)
    np.testing.assert_allclose(
        Ward(GREY, ONE, 0.3, 0.3).eval_brdf(wi, wo)[:, 0], plain, rtol=1e-11, atol=1e-30
    )


@pytest.mark.parametrize("alpha", [0.05, 0.1])
def test_oblique_light_is_neither_lost_nor_multiplied(alpha):
    """Why this form: the others lose light, or create it."""
    cosines = np.array([1e-6, 1e-3, 0.05, 0.3])
    got = directional_albedo(Ward(GREY, ONE, alpha, alpha), cosines)[:, 0]
    assert (got <= 1.0).all()
    assert (got > 0.8).all()
    ward, duer = (
        directional_albedo(OtherForm(alpha, power), cosines)[:, 0] for power in (0.5, 1.0)
    )
    assert ward[3] < 0.31
    assert ward[0] > 3.0
    assert duer[1] > 10.0
    # and at normal light there is nothing to choose between them
    forms = [OtherForm(0.05, 0.5), OtherForm(0.05, 1.0), Ward(GREY, ONE, 0.05, 0.05)]
    assert np.ptp([directional_albedo(form, ONE)[0, 0] for form in forms]) < 0.006


def test_the_narrow_slope_lies_along_x():
    brushed = Ward(GREY, ONE, 0.05, 0.5)
    up = np.array([[0.0, 0.0, 1.0]])
    along, across = np.array([[0.3, 0.0, 1.0]]), np.array([[0.0, 0.3, 1.0]])
    along, across = along / np.sqrt(1.09), across / np.sqrt(1.09)
    assert brushed.eval_brdf(up, across) > 100 * brushed.eval_brdf(up, along)
    assert not brushed.is_isotropic
    assert Ward(GREY, ONE, 0.3, 0.3).is_isotropic
