import numpy as np
import pytest

from prtbake_workers.brdf.checks import directional_albedo
from prtbake_workers.brdf.ggx import Ggx, smith_g1, trowbridge_reitz

GREY = np.array([0.0])
ONE = np.array([1.0])


def facets(n_tan=600, n_phi=256):
    """Facet normals h on the hemisphere and their weights; tan theta = u / (1 - u)."""
    u = (np.arange(n_tan) + 0.5) / n_tan
    tan = u / (1 - u)
    cos = 1 / np.sqrt(1 + tan * tan)
    sin = tan * cos
    weight = 2 * np.pi * sin * cos**2 / (1 - u) ** 2 / n_tan
    phi = 2 * np.pi * (np.arange(n_phi) + 0.5) / n_phi
    return cos[:, None], sin[:, None], phi, weight[:, None] / n_phi


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_facets_cover_the_plane(alpha):
    cos, sin, _, weight = facets(n_tan=4000, n_phi=1)
    got = np.sum(trowbridge_reitz(cos, sin**2, alpha) * cos * weight)
    # midpoint rule of order n^-2
    assert abs(got - 1) < 1e-4
    # twin: a factor pi or one power of the cosine is seen
    assert abs(np.sum(trowbridge_reitz(cos, sin**2, alpha) * np.pi * cos * weight) - 1) > 1
    assert abs(np.sum(trowbridge_reitz(cos, sin**2, alpha) * weight) - 1) > 1e-3


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
@pytest.mark.parametrize("cos_o", [0.1, 0.5, 0.9])
def test_white_furnace_weak(alpha, cos_o):
    """Masked facets seen from wo cover exactly the surface: the weak white furnace test.

    integral of G1(wo) max(0, wo . h) D(h) dh = cos_o, which is the integral of
    D G1 / (4 cos_o) over all reflected directions, those below the horizon included.
    """
    cos, sin, phi, weight = facets()
    wo_h = cos * cos_o + sin * np.sqrt(1 - cos_o**2) * np.cos(phi)
    seen = trowbridge_reitz(cos, sin**2, alpha) * np.maximum(wo_h, 0) * weight
    g1 = smith_g1(np.array([cos_o]), alpha)
    # midpoint rule of order n^-2; worst 2.3e-5
    assert abs(g1[0] * seen.sum() / cos_o - 1) < 5e-5
    # twin: another roughness in the masking than in the facets fails
    assert abs(smith_g1(np.array([cos_o]), 1.5 * alpha)[0] * seen.sum() / cos_o - 1) > 5e-4


def test_albedo_of_the_roughest_at_normal_view():
    """At alpha = 1 the facets' density is constant and the albedo is 1 - ln 2."""
    got = directional_albedo(Ggx(GREY, ONE, 1.0, ONE), ONE)
    np.testing.assert_allclose(got, 1 - np.log(2), rtol=1e-9)  # Gauss nodes, smooth


def scalar_ggx(wi, wo, alpha, f0):
    """Walter's and Heitz's formulas with tangents, for one pair of directions."""
    h = (wi + wo) / np.linalg.norm(wi + wo)
    tan2 = np.tan(np.arccos(h[2])) ** 2
    density = alpha**2 / (np.pi * h[2] ** 4 * (alpha**2 + tan2) ** 2)
    lam_i, lam_o = (
        (-1 + np.sqrt(1 + alpha**2 * np.tan(np.arccos(w[2])) ** 2)) / 2 for w in (wi, wo)
    )
    fresnel = f0 + (1 - f0) * (1 - float(wo @ h)) ** 5
    return fresnel * density / (1 + lam_i + lam_o) / (4 * wi[2] * wo[2])


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_values_are_those_of_the_formula(directions, alpha):
    wi, wo = directions(100), directions(100, seed=2)
    got = Ggx(GREY, ONE, alpha, np.array([0.04])).eval_brdf(wi, wo)[:, 0]
    plain = [scalar_ggx(a, b, alpha, 0.04) for a, b in zip(wi, wo, strict=True)]
    # the twin's arc cosines cost digits near the normal
    np.testing.assert_allclose(got, plain, rtol=1e-9)
    wrong = [scalar_ggx(a, b, alpha**0.5 + 0.01, 0.04) for a, b in zip(wi, wo, strict=True)]
    assert np.abs(np.array(wrong) / got - 1).max() > 1e-3
