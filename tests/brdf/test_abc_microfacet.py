import math

import numpy as np
import pytest

from prtbake_storage.contract.brdf_fits import AbcSpec
from prtbake_workers.brdf.abc_microfacet import fresnel_dielectric
from prtbake_workers.brdf.checks import check_reciprocity
from prtbake_workers.brdf.registry import brdf_from_spec

SPEC = AbcSpec(kd=(0.3, 0.1, 0.0), a=(20.0, 30.0, 5.0), b=5000.0, c=1.2, ior=1.6)


@pytest.mark.parametrize("ior", [1.0, 1.33, 2.5, 99.0])
def test_fresnel_at_its_ends(ior):
    normal, grazing = fresnel_dielectric(np.array([1.0, 0.0]), ior)
    assert normal == pytest.approx(((ior - 1) / (ior + 1)) ** 2, abs=1e-15)
    # equal media have no surface; 0 / 0 at grazing is held at its limit from ior = 1
    assert grazing == pytest.approx(1.0 if ior > 1 else 0.0, abs=1e-15)


def test_fresnel_at_brewsters_angle_has_one_polarisation():
    """tan theta = n: the parallel part vanishes, and the other is ((n^2 - 1) / (n^2 + 1))^2."""
    n = 1.5
    got = fresnel_dielectric(np.array([math.cos(math.atan(n))]), n)[0]
    assert got == pytest.approx(0.5 * ((n * n - 1) / (n * n + 1)) ** 2, rel=1e-12)
    assert got < fresnel_dielectric(np.array([0.2]), n)[0]


def scalar_abc(wi, wo, channel, divisor=math.pi):
    h = (wi + wo) / np.linalg.norm(wi + wo)
    d = float(wi @ h)
    n = SPEC.ior
    t = math.asin(math.sin(math.acos(d)) / n)
    i = math.acos(d)
    fresnel = 0.5 * (
        (math.sin(i - t) / math.sin(i + t)) ** 2 + (math.tan(i - t) / math.tan(i + t)) ** 2
    )
    facets = SPEC.a[channel] / (1 + SPEC.b * (1 - h[2])) ** SPEC.c
    cavity = min(1.0, 2 * h[2] * wi[2] / d, 2 * h[2] * wo[2] / d)
    return SPEC.kd[channel] / math.pi + fresnel * facets * cavity / (divisor * wi[2] * wo[2])


def test_values_are_those_of_the_formulas(directions):
    wi, wo = directions(200), directions(200, seed=2)
    got = brdf_from_spec(SPEC).eval_brdf(wi, wo)
    plain = [[scalar_abc(a, b, c) for c in range(3)] for a, b in zip(wi, wo, strict=True)]
    # the twin's 1 - cos_h and its arc cosines lose digits near the normal
    np.testing.assert_allclose(got, plain, rtol=1e-7)
    wrong = [[scalar_abc(a, b, c, 4.0) for c in range(3)] for a, b in zip(wi, wo, strict=True)]
    assert np.abs(np.array(wrong) / got - 1).max() > 0.1


def test_it_is_reciprocal():
    assert check_reciprocity(brdf_from_spec(SPEC)).reciprocal
