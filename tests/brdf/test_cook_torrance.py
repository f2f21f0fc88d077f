import numpy as np
import pytest

from prtbake_workers.brdf.checks import directional_albedo
from prtbake_workers.brdf.cook_torrance import CookTorrance, beckmann

GREY = np.array([0.0])
ONE = np.array([1.0])


def projected_integral(density, n=20_000):
    """Integrate a density of cos_h against cos_h over the hemisphere; tan theta = u / (1 - u)."""
    u = (np.arange(n) + 0.5) / n
    tan = u / (1 - u)
    cos = 1 / np.sqrt(1 + tan * tan)
    # d omega cos = 2 pi sin cos d theta, d theta = cos^2 / (1 - u)^2 d u
    return np.sum(density(cos, 1 - cos * cos) * 2 * np.pi * tan * cos**4 / (1 - u) ** 2) / n


@pytest.mark.parametrize("m", [0.05, 0.3, 1.0, 2.0])
def test_facets_cover_the_plane(m):
    """The facets' projected area is the area of the surface: what fixes 1 / (pi m^2 cos^4)."""
    got = projected_integral(lambda c, s2: beckmann(c, s2, m))
    # midpoint rule of order n^-2
    assert abs(got - 1) < 1e-4
    # twin: a factor pi or one power of the cosine is seen
    assert abs(projected_integral(lambda c, s2: beckmann(c, s2, m) * np.pi) - 1) > 1
    assert abs(projected_integral(lambda c, s2: beckmann(c, s2, m) * c) - 1) > 1e-3


def scalar_cook_torrance(wi, wo, kd, ks, m, f0):
    """The formula letter by letter, for one pair of directions."""
    h = (wi + wo) / np.linalg.norm(wi + wo)
    n_h, n_i, n_o, v_h = h[2], wi[2], wo[2], float(wo @ h)
    fresnel = f0 + (1 - f0) * (1 - v_h) ** 5
    tan = np.tan(np.arccos(n_h))
    density = np.exp(-((tan / m) ** 2)) / (np.pi * m**2 * n_h**4)
    shadowing = min(1.0, 2 * n_h * n_o / v_h, 2 * n_h * n_i / v_h)
    return kd / np.pi + ks * fresnel * density * shadowing / (4 * n_i * n_o)


@pytest.mark.parametrize("m", [0.1, 0.5, 1.5])
def test_values_are_those_of_the_formula(directions, m):
    brdf = CookTorrance(np.array([0.3]), np.array([0.7]), m, np.array([0.1]))
    wi, wo = directions(100), directions(100, seed=2)
    got = brdf.eval_brdf(wi, wo)[:, 0]
    plain = [scalar_cook_torrance(a, b, 0.3, 0.7, m, 0.1) for a, b in zip(wi, wo, strict=True)]
    # the twin's arc cosine costs digits where h is near the normal
    np.testing.assert_allclose(got, plain, rtol=1e-10)
    wrong = [scalar_cook_torrance(a, b, 0.3, 0.7, m, 0.11) for a, b in zip(wi, wo, strict=True)]
    assert np.abs(np.array(wrong) / got - 1).max() > 1e-3


def test_white_cavities_lose_no_light_on_smooth_facets():
    """With F = 1 and shallow slopes nearly all light leaves; never more than came."""
    albedo = directional_albedo(CookTorrance(GREY, ONE, 0.05, ONE), np.array([0.3, 0.6, 1.0]))
    assert (albedo <= 1 + 1e-9).all()
    assert (albedo > 0.99).all()


def test_coloured_f0_fades_to_white_at_grazing():
    brdf = CookTorrance(np.zeros(3), np.ones(3), 0.3, np.array([1.0, 0.77, 0.34]))
    z = 1e-3
    wi = np.array([[0, 0, 1.0], [np.sqrt(1 - z * z), 0, z]])
    value = brdf.eval_brdf(wi, wi * np.array([-1.0, 1.0, 1.0]))
    np.testing.assert_allclose(value[0] / value[0, 0], [1.0, 0.77, 0.34], rtol=1e-12)
    np.testing.assert_allclose(value[1] / value[1, 0], 1.0, rtol=5e-3)  # 1 - 0.66 * 5 z is left
