import math

import numpy as np
import pytest

from prtbake_storage.contract.brdf_fits import SgdSpec
from prtbake_workers.brdf.checks import check_reciprocity
from prtbake_workers.brdf.registry import brdf_from_spec

# three surfaces in one: a smooth one, a rough one, and one whose f0 exceeds 1, as fits have it
PARAMETERS = {
    "rho_d": (0.1, 0.3, 0.0),
    "rho_s": (0.2, 0.8, 0.05),
    "alpha": (0.01, 0.4, 0.05),
    "p": (0.4, 1.1, 0.6),
    "f0": (0.05, 0.3, 4.0),
    "f1": (0.0, -0.1, 3.1),
    "kappa": (40.0, 3.0, 20.0),
    "lam": (2.0, 3.0, 1.0),
    "c": (1e-4, 0.05, 1e-6),
    "k": (20.0, 4.0, 30.0),
    "theta0": (0.1, -0.2, 0.4),
}
SPEC = SgdSpec(**PARAMETERS)


def scalar_sgd(wi, wo, channel, shift=0.0):
    """The formulas of the paper with angles, one channel of one pair."""
    q = {name: values[channel] for name, values in PARAMETERS.items()}
    h = (wi + wo) / np.linalg.norm(wi + wo)
    c, theta_h = float(wi @ h), math.acos(h[2])
    fresnel = max(0.0, q["f0"] - c * q["f1"] + (1 - c) ** 5 * (1 - q["f0"]))
    tan2 = math.tan(theta_h) ** 2
    x = q["alpha"] + tan2 / q["alpha"]
    facets = q["kappa"] * math.exp(-x) / (math.pi * x ** q["p"] * math.cos(theta_h) ** 4)

    def shadow(w):
        beyond = max(0.0, math.acos(w[2]) - q["theta0"] - shift)
        return min(1.0, max(0.0, 1 + q["lam"] * (1 - math.exp(q["c"] * beyond ** q["k"]))))

    lobe = fresnel * facets * shadow(wi) * shadow(wo) / (wi[2] * wo[2])
    return (q["rho_d"] + q["rho_s"] * lobe) / math.pi


def test_values_are_those_of_the_formulas(directions):
    wi, wo = directions(200), directions(200, seed=2)
    got = brdf_from_spec(SPEC).eval_brdf(wi, wo)
    plain = [[scalar_sgd(a, b, c) for c in range(3)] for a, b in zip(wi, wo, strict=True)]
    # the twin's arc cosines cost digits near the normal, which 1 / alpha multiplies
    np.testing.assert_allclose(got, plain, rtol=1e-8)
    wrong = [[scalar_sgd(a, b, c, 0.05) for c in range(3)] for a, b in zip(wi, wo, strict=True)]
    lit = got > 0
    assert np.abs(np.array(wrong)[lit] / got[lit] - 1).max() > 1e-2


def test_it_is_reciprocal():
    assert check_reciprocity(brdf_from_spec(SPEC)).max_relative < 1e-14


@pytest.mark.parametrize(
    "extreme",
    [
        {"c": (1e38,) * 3, "k": (700.0,) * 3},
        {"c": (0.0,) * 3},
        {"lam": (1e9,) * 3, "theta0": (-3.0,) * 3},
        {"alpha": (1e-9,) * 3, "p": (10.0,) * 3},
        {"f0": (-5.0,) * 3},
    ],
)
def test_what_fits_hold_at_their_ends_stays_finite(extreme):
    brdf = brdf_from_spec(SgdSpec(**(PARAMETERS | extreme)))
    cos = np.array([1e-300, 1e-12, 1e-6, 1e-3, 0.3, 1.0])
    sin = np.sqrt(1 - cos * cos)
    wi = np.stack([sin, 0 * sin, cos], axis=-1)[:, None]
    for phi in (0.0, 1.0, np.pi):
        wo = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=-1)[None]
        value = brdf.eval_brdf(wi, wo)
        assert np.isfinite(value).all()
        assert (value >= 0.0).all()


def test_no_shadowing_without_slope():
    """c = 0: G is 1 everywhere, and the lobe's cosines are left alone."""
    brdf = brdf_from_spec(SgdSpec(**(PARAMETERS | {"c": (0.0,) * 3, "rho_d": (0.0,) * 3})))
    up, low = np.array([[0.0, 0.0, 1.0]]), np.array([[0.8, 0.0, 0.6]])
    half = (up + low) / np.linalg.norm(up + low)
    other = np.array([[half[0, 0], 0.0, half[0, 2]]])
    ratio = brdf.eval_brdf(up, low) / brdf.eval_brdf(other, other)
    q = {name: np.array(values) for name, values in PARAMETERS.items()}
    fresnel = [
        q["f0"] - c * q["f1"] + (1 - c) ** 5 * (1 - q["f0"]) for c in (float(half[0, 2]), 1.0)
    ]
    np.testing.assert_allclose(ratio[0], fresnel[0] / fresnel[1] * half[0, 2] ** 2 / 0.6, rtol=1e-9)
