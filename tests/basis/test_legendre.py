"""The general product integral by Legendre series as the oracle of both kernels, over all widths."""

import numpy as np
import pytest

from prtbake_workers.basis.legendre import (
    abel_poisson_legendre,
    gaussian_legendre,
    legendre_product_integral,
)
from prtbake_workers.basis.srbf import (
    abel_poisson,
    abel_poisson_product_integral,
    gaussian,
    gaussian_product_integral,
)
from support.quadrature import sphere_quadrature

COSINES = [1.0, 0.999, 0.3, -0.2, -1.0]


def gaussian_degrees(lam):
    """Where the docstring says that the series has converged."""
    return int(8 * np.sqrt(lam) + 20)


@pytest.mark.parametrize(
    ("lam_g", "lam_h"),
    [
        (1e-6, 1e-3), (1e-3, 60.0), (7.0, 15.0), (60.0, 60.0), (162.1, 52.2),
        (1e3, 162.1), (1e4, 1e4), (1e5, 3.0), (1e6, 1e4),
    ],
)  # fmt: skip
def test_gaussian_products_equal_their_series(lam_g, lam_h):
    # the product of two series ends where the wider kernel's does
    n = gaussian_degrees(min(lam_g, lam_h))
    g, h = gaussian_legendre(lam_g, n), gaussian_legendre(lam_h, n)
    series = [legendre_product_integral(g, h, c) for c in COSINES]
    closed = gaussian_product_integral(lam_g, lam_h, np.array(COSINES))
    # the series cancels, so that its rounding is relative to its value at equal centres: 1e-14
    # measured, half of it the Bessel function's
    np.testing.assert_allclose(closed, series, rtol=0, atol=3e-14 * series[0])
    # negative twins: the equation as printed, without exp(-(lam_g + lam_h)), and a cut series
    if lam_g + lam_h > 1.0:
        assert abs(closed[0] / series[0] * np.exp(min(lam_g + lam_h, 300.0)) - 1.0) > 1.0
        short = legendre_product_integral(g[: n // 8], h[: n // 8], 1.0)
        assert abs(short / series[0] - 1.0) > 1e-7


@pytest.mark.parametrize(
    ("lam_g", "lam_h"), [(1e-6, 0.5), (0.5, 0.7), (0.9, 0.8), (0.99, 0.97), (0.99, 0.999)]
)
def test_abel_poisson_products_equal_their_series(lam_g, lam_h):
    n = int(40.0 / -np.log(lam_g * lam_h)) + 20  # (lam_g lam_h)^n = e^-40
    g, h = abel_poisson_legendre(lam_g, n), abel_poisson_legendre(lam_h, n)
    series = [legendre_product_integral(g, h, c) for c in COSINES]
    closed = abel_poisson_product_integral(lam_g, lam_h, np.array(COSINES))
    np.testing.assert_allclose(closed, series, rtol=0, atol=1e-14 * series[0])
    assert closed[0] / (4 * np.pi) != pytest.approx(series[0], rel=0.5)  # eq. (5) as printed


def test_unlike_kernels_equal_quadrature():
    """What neither closed form gives: a Gaussian times an Abel-Poisson kernel."""
    directions, weights = sphere_quadrature(120)
    first, second = np.array([0.6, 0.0, 0.8]), np.array([-0.28, 0.0, 0.96])
    product = gaussian(directions @ first, 11.0) * abel_poisson(directions @ second, 0.7)
    series = legendre_product_integral(
        gaussian_legendre(11.0, 60), abel_poisson_legendre(0.7, 60), float(first @ second)
    )
    assert series == pytest.approx(float(weights @ product), rel=1e-12)
    swapped = legendre_product_integral(
        gaussian_legendre(11.0, 60), abel_poisson_legendre(0.6, 60), float(first @ second)
    )
    assert swapped != pytest.approx(series, rel=0.05)
