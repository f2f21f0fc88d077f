import numpy as np
import pytest

from prtbake_workers.brdf.checks import directional_albedo
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.oren_nayar import OrenNayar

ONE = np.array([1.0])


def by_angles(wi, wo, albedo, sigma, a_term=0.33):
    """The paper's qualitative model with the angles themselves."""
    theta_i, theta_o = np.arccos(wi[..., 2]), np.arccos(wo[..., 2])
    dphi = np.arctan2(wi[..., 1], wi[..., 0]) - np.arctan2(wo[..., 1], wo[..., 0])
    a = 1 - 0.5 * sigma**2 / (sigma**2 + a_term)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    alpha, beta = np.maximum(theta_i, theta_o), np.minimum(theta_i, theta_o)
    facing = np.maximum(0, np.cos(dphi)) * np.sin(alpha) * np.tan(beta)
    return albedo / np.pi * (a + b * facing)


@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.5])
def test_values_are_those_of_the_paper(directions, sigma):
    wi, wo = directions(300), directions(300, seed=2)
    got = OrenNayar(np.array([0.7]), sigma).eval_brdf(wi, wo)[:, 0]
    # the twin's arc cosines cost digits near the normal
    np.testing.assert_allclose(got, by_angles(wi, wo, 0.7, sigma), rtol=1e-10)
    # 0.57 in place of 0.33 stands for the bounced light, which this form leaves out
    wrong = by_angles(wi, wo, 0.7, sigma, a_term=0.57)
    assert np.abs(wrong / got - 1).max() > 1e-3


def test_smooth_facets_are_lambert(directions):
    wi, wo = directions(50), directions(50, seed=2)
    albedo = np.array([0.7, 0.2, 0.1])
    got = OrenNayar(albedo, 0.0).eval_brdf(wi, wo)
    np.testing.assert_allclose(got, Lambert(albedo).eval_brdf(wi, wo), rtol=1e-15)


def test_why_not_the_full_model():
    """C1 to C3 and the bounced light of the paper: below 0 for dark facets at 80 degrees."""
    sigma, albedo, angle = 1.0, 0.1, np.deg2rad(80)
    s2 = sigma**2
    c1 = 1 - 0.5 * s2 / (s2 + 0.33)
    c2 = 0.45 * s2 / (s2 + 0.09) * (np.sin(angle) - (2 * angle / np.pi) ** 3)
    # light and view opposite: cos dphi = -1, where the C3 term vanishes
    once = albedo / np.pi * (c1 - c2 * np.tan(angle))
    bounced = 0.17 * albedo**2 / np.pi * s2 / (s2 + 0.13) * (1 + (2 * angle / np.pi) ** 2)
    assert once + bounced < -1e-4
    wi = np.array([[np.sin(angle), 0.0, np.cos(angle)]])
    opposite = wi * [-1, 1, 1]
    assert OrenNayar(np.array([albedo]), sigma).eval_brdf(wi, opposite)[0, 0] > 0.01


@pytest.mark.parametrize("sigma", [0.2, 1.0])
def test_albedo_at_normal_and_at_grazing_light(sigma):
    """A at normal light; A + B / 2 at grazing: tan b cos b integrates to pi / 2 over half a turn."""
    a = 1 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    b = 0.45 * sigma**2 / (sigma**2 + 0.09)
    got = directional_albedo(OrenNayar(ONE, sigma), np.array([1e-6, 1.0]))[:, 0]
    # the light stands 1e-6 above the horizon
    np.testing.assert_allclose(got, [a + b / 2, a], rtol=1e-5)
    assert abs(got[0] / got[1] - 1) > 0.05


def test_rough_surfaces_look_flat_from_the_light():
    """The paper's point: seen from the light the full moon does not darken to its edge."""
    cosines = np.array([0.2, 0.5, 0.9])
    wi = np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)
    seen = {s: OrenNayar(ONE, s).eval_brdf(wi, wi)[:, 0] * cosines for s in (0.0, 0.8)}
    assert np.ptp(seen[0.8]) / seen[0.8].max() < 0.5 * np.ptp(seen[0.0]) / seen[0.0].max()
