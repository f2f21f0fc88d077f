"""Kernels and product integrals against quadrature, Legendre series and 60-digit arithmetic."""

from decimal import Decimal, localcontext

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.legendre import (
    abel_poisson_legendre,
    gaussian_legendre,
    legendre_product_integral,
)
from prtbake_workers.basis.srbf import (
    SrbfBasis,
    abel_poisson,
    abel_poisson_product_integral,
    default_bandwidth,
    gaussian,
    gaussian_product_integral,
)
from prtbake_workers.geometry.icosphere import icosphere
from support.quadrature import sphere_quadrature

EPS = np.finfo(np.float64).eps
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")


def exact_product(lam_g, lam_h, cos_angle):
    """Eq. (27) with its lost factor, as written, in arithmetic that can bear it.

    Returns the value and its exponent r - lam_g - lam_h.
    """
    with localcontext() as context:
        context.prec = 60
        context.Emin, context.Emax = -(10**8), 10**8
        g, h, c = Decimal(lam_g), Decimal(lam_h), Decimal(cos_angle)
        r = (g * g + h * h + 2 * g * h * c).sqrt()
        if r < Decimal("1e-20"):
            return float(4 * PI * (-(g + h)).exp()), float(-(g + h))
        sinh = (r.exp() - (-r).exp()) / 2
        return float(4 * PI * (-(g + h)).exp() * sinh / r), float(r - g - h)


CENTRE_G = np.array([0.6, 0.0, 0.8])
CENTRE_H = np.array([-0.28, 0.0, 0.96])
COS = float(CENTRE_G @ CENTRE_H)


@pytest.mark.parametrize(
    ("kernel", "product", "lam_g", "lam_h"),
    [
        (gaussian, gaussian_product_integral, 3.0, 11.0),
        (gaussian, gaussian_product_integral, 0.01, 60.0),
        (abel_poisson, abel_poisson_product_integral, 0.5, 0.7),
        (abel_poisson, abel_poisson_product_integral, 0.9, 0.8),
    ],
)
def test_product_integral_equals_quadrature(kernel, product, lam_g, lam_h):
    directions, weights = sphere_quadrature(140)
    g = kernel(directions @ CENTRE_G, lam_g)
    h = kernel(directions @ CENTRE_H, lam_h)
    expected = float(np.sum(weights * g * h))
    # 1e-12: rounding of 39,200 summands of one sign; the rule itself has converged
    assert product(lam_g, lam_h, COS) == pytest.approx(expected, rel=1e-12)
    # negative twins: the equations as printed, without 4 pi
    assert product(lam_g, lam_h, COS) / (4 * np.pi) != pytest.approx(expected, rel=0.5)


@pytest.mark.parametrize(("lam_g", "lam_h"), [(0.5, 0.7), (0.9, 0.8)])
def test_erratum_of_equation_5_is_a_factor_of_4_pi(lam_g, lam_h):
    lam = lam_g * lam_h
    printed = (1 - lam**2) / (1 - 2 * lam * COS + lam**2) ** 1.5
    ratio = abel_poisson_product_integral(lam_g, lam_h, COS) / printed
    assert ratio == pytest.approx(12.566370614, rel=1e-10)


def test_erratum_of_equation_27_is_the_exponential_factor():
    lam_g, lam_h = 2.0, 5.0
    r = np.linalg.norm(lam_g * CENTRE_G + lam_h * CENTRE_H)
    printed = 4 * np.pi * np.sinh(r) / r
    ratio = gaussian_product_integral(lam_g, lam_h, COS) / printed
    assert ratio == pytest.approx(np.exp(-(lam_g + lam_h)), rel=1e-13)


@pytest.mark.parametrize("cos_angle", [1.0, 0.3, -0.2, -1.0])
def test_product_integrals_equal_their_legendre_series(cos_angle):
    g, h = gaussian_legendre(7.0, 80), gaussian_legendre(15.0, 80)
    series = legendre_product_integral(g, h, cos_angle)
    at_one = legendre_product_integral(g, h, 1.0)
    # the series cancels: its rounding is relative to its value at equal centres
    np.testing.assert_allclose(
        gaussian_product_integral(7.0, 15.0, cos_angle), series, rtol=1e-12, atol=1e-14 * at_one
    )
    g, h = abel_poisson_legendre(0.6, 200), abel_poisson_legendre(0.8, 200)
    series = legendre_product_integral(g, h, cos_angle)
    np.testing.assert_allclose(
        abel_poisson_product_integral(0.6, 0.8, cos_angle), series, rtol=1e-12
    )
    wrong = legendre_product_integral(g, h * np.arange(1.0, 201.0), cos_angle)
    assert abs(wrong / series - 1.0) > 1e-3


def test_legendre_series_sums_to_the_kernel():
    t = np.array([1.0, 0.7, 0.0, -0.9])
    degrees = [np.polynomial.legendre.legval(t, gaussian_legendre(20.0, 70))]
    # 1e-13 absolute: the series sums to values down to e^-38 beside terms near 1
    np.testing.assert_allclose(degrees[0], gaussian(t, 20.0), rtol=0, atol=1e-13)
    poisson = np.polynomial.legendre.legval(t, abel_poisson_legendre(0.7, 150))
    np.testing.assert_allclose(poisson, abel_poisson(t, 0.7), rtol=1e-12)


def test_integrals_broadcast_and_clip():
    lam = np.array([[1.0], [30.0]])
    c = np.array([-1.0 - 1e-15, 0.0, 1.0 + 1e-15])
    values = gaussian_product_integral(lam, 4.0, c)
    assert values.shape == (2, 3)
    assert np.isfinite(values).all()
    assert values[0, 2] == gaussian_product_integral(1.0, 4.0, 1.0)
    assert gaussian(1.0 + 1e-15, 1e6) == 1.0


@pytest.mark.parametrize("lam", [1e-9, 0.5, 1.0 - 1e-9])
def test_abel_poisson_near_its_ends(lam):
    with localcontext() as context:
        context.prec = 60
        x, one = Decimal(lam), Decimal(1)
        # (lam, lam) on equal centres: 4 pi (1 + lam^2) / (1 - lam^2)^2, without cancellation
        expected = float(4 * PI * (one + x * x) / (one - x * x) ** 2)
        at_zero = float((one - x * x) / (one + x * x) ** Decimal("1.5"))
    # 1e-12: 1 - lam is exact, but 1 - (1 - width) loses a digit or two of the product
    assert abel_poisson_product_integral(lam, lam, 1.0) == pytest.approx(expected, rel=1e-12)
    assert abel_poisson(0.0, lam) == pytest.approx(at_zero, rel=1e-12)


def test_default_bandwidth_keeps_the_shape():
    assert default_bandwidth(642) == 60.0
    assert default_bandwidth(2562) / 2562 == pytest.approx(default_bandwidth(12) / 12)


@pytest.fixture(scope="module")
def basis():
    return SrbfBasis(icosphere(2))


def test_gram_is_the_integral_of_the_basis(basis):
    directions, weights = sphere_quadrature(60)
    y = basis.evaluate(directions)
    gram = y.T @ (weights[:, None] * y)
    np.testing.assert_allclose(basis.gram, gram, atol=1e-12 * gram.max(), rtol=0)


def test_whitened_basis_is_orthonormal(basis):
    directions, weights = sphere_quadrature(60)
    b = basis.reconstruction_matrix(directions)
    # 1e-9: rounding times the root of the condition number, 6e4
    np.testing.assert_allclose(b.T @ (weights[:, None] * b), np.eye(basis.n), rtol=0, atol=1e-9)
    y = basis.evaluate(directions)
    assert np.abs(y.T @ (weights[:, None] * y) - np.eye(basis.n)).max() > 0.1


def test_light_from_radiance_holds_the_overlaps_with_its_lobes(basis, rng):
    directions, weights = sphere_quadrature(100)
    centres = rng.normal(size=(5, 3))
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    bandwidths = np.array([2.0, 8.0, 30.0, 60.0, 1.0])
    coefficients = rng.normal(size=(5, 3))
    radiance = gaussian(directions @ centres.T, bandwidths) @ coefficients
    sampled = basis.light_from_radiance(directions, weights, radiance)

    def lobes(lam):
        overlaps = gaussian_product_integral(basis.bandwidth, lam, basis.centres @ centres.T)
        return basis.whitening.inv_sqrt_gram @ (overlaps @ coefficients)

    # 1e-9 of the largest: G^(-1/2) amplifies rounding by the root of the condition number
    atol = 1e-9 * np.abs(sampled).max()
    np.testing.assert_allclose(sampled, lobes(bandwidths), rtol=0, atol=atol)
    assert np.abs(lobes(bandwidths * 1.001) - sampled).max() > 1e3 * atol


def test_bad_bases_are_refused_by_name():
    with pytest.raises(SettingsError, match=r"bandwidth 12\.7 is too small for 642 centres"):
        SrbfBasis(icosphere(3), 12.7)
    with pytest.raises(SettingsError, match="bandwidth must be a positive number"):
        SrbfBasis(icosphere(0), -1.0)
    centres = icosphere(0)
    centres[3] *= 2.0
    with pytest.raises(SettingsError, match="centre 3 is no unit vector"):
        SrbfBasis(centres, 2.0)
    doubled = np.concatenate([icosphere(0), icosphere(0)[:1]])
    with pytest.raises(SettingsError, match="condition number"):
        SrbfBasis(doubled, 2.0)


def test_offered_bandwidth_works():
    with pytest.raises(SettingsError, match=r"a bandwidth of 10\.0935 or more works"):
        SrbfBasis(icosphere(2), 1.0)
    assert SrbfBasis(icosphere(2), 10.0935).condition < 1e9


def test_centres_without_antipodes_get_the_same_roots(rng):
    """The split into even and odd functions is a short cut, not another answer."""
    centres = icosphere(1)
    whole = SrbfBasis(centres, 6.0).whitening
    half = SrbfBasis(centres[:-1], 6.0)
    direct = half.whitening
    np.testing.assert_allclose(direct.sqrt_gram @ direct.sqrt_gram, half.gram, rtol=0, atol=1e-13)
    gram = SrbfBasis(centres, 6.0).gram
    np.testing.assert_allclose(whole.sqrt_gram @ whole.sqrt_gram, gram, rtol=0, atol=1e-13)
    values, vectors = np.linalg.eigh(gram)
    np.testing.assert_allclose(
        whole.sqrt_gram, (vectors * np.sqrt(values)) @ vectors.T, rtol=0, atol=1e-12
    )
    assert whole.condition == pytest.approx(values[-1] / values[0], rel=1e-9)
    order = rng.permutation(len(centres))
    shuffled = SrbfBasis(centres[order], 6.0).whitening
    np.testing.assert_allclose(
        shuffled.sqrt_gram, whole.sqrt_gram[np.ix_(order, order)], rtol=0, atol=1e-12
    )


def test_exact_product_is_not_the_code_under_test():
    """The oracle's own check: at moderate values it agrees with the plain formula."""
    r = np.sqrt(9 + 25 + 30 * 0.2)
    plain = 4 * np.pi * np.exp(-8.0) * np.sinh(r) / r
    assert exact_product(3.0, 5.0, 0.2)[0] == pytest.approx(plain, rel=1e-14)
