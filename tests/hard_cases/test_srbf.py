"""Bandwidths from 1e-6 to 1e6, antipodal and equal centres, ill-conditioned bases."""

from decimal import Decimal, localcontext

import numpy as np
import pytest

from prtbake_storage.decode.srbf import gram_matrix, whitening
from prtbake_workers.basis.srbf import SrbfBasis, gaussian, gaussian_product_integral
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.transport.directions import cube_directions

EPS = float(np.finfo(np.float64).eps)
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494459")
BANDWIDTHS = [1e-6, 1e-3, 0.5, 1.0, 37.0, 162.1, 710.5, 1e4, 1e6]
COSINES = [1.0, 1.0 - 1e-15, 1.0 - 1e-7, 0.9, 0.0, -0.5, -1.0 + 1e-12, -1.0]


def exact(lam_g, lam_h, cos_angle):
    """Value and exponent of the product integral in 80-digit arithmetic, by its plain formula."""
    with localcontext() as context:
        context.prec = 80
        context.Emin, context.Emax = -(10**8), 10**8
        g, h, c = Decimal(lam_g), Decimal(lam_h), Decimal(cos_angle)
        r = max(Decimal(0), g * g + h * h + 2 * g * h * c).sqrt()
        if r == 0:
            return 4 * PI * (-(g + h)).exp(), float(-(g + h))
        return 4 * PI * (-(g + h)).exp() * (r.exp() - (-r).exp()) / (2 * r), float(r - g - h)


@pytest.mark.parametrize("lam_g", BANDWIDTHS)
@pytest.mark.parametrize("lam_h", BANDWIDTHS)
def test_product_integral_at_every_scale(lam_g, lam_h):
    for cos_angle in COSINES:
        value, exponent = exact(lam_g, lam_h, cos_angle)
        got = float(gaussian_product_integral(lam_g, lam_h, cos_angle))
        if exponent < -700.0:  # below float64's normal numbers
            assert 0.0 <= got <= 1e-290
            continue
        # a few roundings, and the exponent's own rounding, which exp turns into a relative error
        assert abs(Decimal(got) / value - 1) < 8 * EPS + 2 * EPS * abs(exponent)


def naive(lam_g, lam_h, cos_angle):
    """Eq. (27) with its factor restored but evaluated as written, r from coordinates."""
    sine = np.sqrt(max(0.0, 1.0 - cos_angle**2))
    r = np.linalg.norm(lam_g * np.array([1.0, 0.0]) + lam_h * np.array([cos_angle, sine]))
    return 4 * np.pi * np.exp(-(lam_g + lam_h)) * np.sinh(r) / r


@pytest.mark.parametrize(
    ("lam_g", "lam_h", "cos_angle"), [(400.0, 400.0, 1.0), (37.0, 37.0, -1.0), (1e6, 1e4, 0.9)]
)
def test_plain_evaluation_fails_where_ours_holds(lam_g, lam_h, cos_angle):
    with np.errstate(all="ignore"):
        plain = naive(lam_g, lam_h, cos_angle)
    value, _ = exact(lam_g, lam_h, cos_angle)
    off = float("inf") if not np.isfinite(plain) else abs(Decimal(float(plain)) / value - 1)
    assert off > 1e-6 or not np.isfinite(plain)


@pytest.mark.parametrize(
    ("subdivisions", "bandwidth", "condition"),
    [(3, 162.0, 51.0), (3, 52.2, 5.9e5), (3, 40.5, 2.4e7)],
)
def test_condition_numbers_of_642_centres(subdivisions, bandwidth, condition):
    measured = whitening(icosphere(subdivisions), bandwidth).condition
    assert measured == pytest.approx(condition, rel=0.02)  # the figures have two digits


def test_642_centres_at_12_7_are_singular_and_say_so():
    roots = whitening(icosphere(3), 12.7)
    assert roots.effective_rank < 642
    assert roots.condition > 1e15
    assert np.isfinite(roots.inv_sqrt_gram).all()


def cosine_lobes(directions, rng, n):
    normals = rng.normal(size=(n, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.maximum(0.0, normals @ directions.T) / np.pi


def plain_float32(basis, cube, samples):
    """Ordinary least squares by the normal equations in float32: raw coefficients."""
    y = basis.evaluate(cube.directions).astype(np.float32)
    weighted = y * cube.weights.astype(np.float32)[:, None]
    return np.linalg.solve(y.T @ weighted, weighted.T @ samples.T.astype(np.float32)).T


def relative(difference, whole):
    return float(np.sum(difference**2) / np.sum(whole**2))


@pytest.mark.parametrize(("bandwidth", "condition"), [(40.5, 2.4e7), (38.0, 6.9e7)])
def test_projection_where_float32_least_squares_fails(bandwidth, condition, rng):
    """Lobes cut off by an occluder, what a baked vertex looks like."""
    basis = SrbfBasis(icosphere(3), bandwidth)
    assert basis.condition == pytest.approx(condition, rel=0.02)
    cube = cube_directions(24)
    seen = cube.directions @ np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0]]).T > 0.2
    samples = cosine_lobes(cube.directions, rng, 2) * seen.T
    projection = basis.projection(cube.directions, cube.weights)
    exact_fit = samples @ projection.matrix
    ours = samples.astype(np.float32) @ projection.matrix.astype(np.float32)
    # float32 samples and products: 5e-14 measured; plain: 3e-5 (40.5) and 3e-3 (38) measured
    assert relative(ours - exact_fit, exact_fit) < 1e-11
    plain = plain_float32(basis, cube, samples)
    in_radiance = plain.astype(np.float64) @ basis.whitening.sqrt_gram
    assert relative(in_radiance - exact_fit, exact_fit) > 1e-6
    # what is stored: whitened coefficients survive float32, raw ones of plain least squares do not
    raw = exact_fit @ basis.whitening.inv_sqrt_gram
    stored = ours.astype(np.float64) @ basis.whitening.inv_sqrt_gram
    assert relative(stored - raw, raw) < 1e-5
    assert relative(plain - raw, raw) > 1e-3


def test_2562_centres_at_162():
    """The worst condition of those above and this: one decomposition of this size is enough."""
    measured = whitening(icosphere(4), 162.0)
    assert measured.condition == pytest.approx(7.0e7, rel=0.02)
    # and the roots are roots
    gram = gram_matrix(icosphere(4), 162.0)
    probe = np.random.default_rng(3).normal(size=2562)
    twice = measured.sqrt_gram @ (measured.sqrt_gram @ probe)
    np.testing.assert_allclose(twice, gram @ probe, rtol=0, atol=1e-12 * np.abs(twice).max())


@pytest.mark.parametrize("subdivisions", [0, 1, 2, 3])
def test_every_small_icosphere_projects_a_function_of_its_own(subdivisions, rng):
    """What lies in the span comes back, whatever the number of centres."""
    basis = SrbfBasis(icosphere(subdivisions))
    cube = cube_directions(24)
    whitened = rng.normal(size=(3, basis.n))
    samples = whitened @ basis.reconstruction_matrix(cube.directions).T
    back = samples @ basis.projection(cube.directions, cube.weights).matrix
    # the ridge takes 1e-4 of the amplitude
    np.testing.assert_allclose(back, whitened, rtol=0, atol=5e-4)
    assert np.abs(samples @ cube_matrix_without_weights(basis, cube) - whitened).max() > 0.01


def cube_matrix_without_weights(basis, cube):
    return basis.reconstruction_matrix(cube.directions) * (4 * np.pi / cube.n)


def test_fewer_directions_than_centres_give_the_fit_of_least_energy(rng):
    basis = SrbfBasis(icosphere(3), 60.0)
    cube = cube_directions(6)  # 216 directions for 642 coefficients
    projection = basis.projection(cube.directions, cube.weights)
    samples = cosine_lobes(cube.directions, rng, 2)
    fit = samples @ projection.matrix
    missed = samples - fit @ projection.samples.T
    assert np.sum(missed**2 @ cube.weights) < 1e-5 * np.sum(samples**2 @ cube.weights)
    assert np.sum(fit**2) < 1.2 * np.sum(samples**2 @ cube.weights)
    assert projection.gram_defect > 0.5
    # the small residual is no success: in other directions the fit is far off
    lobes = np.random.default_rng(5)
    fine = cube_directions(24)
    truth = cosine_lobes(fine.directions, lobes, 2)
    coarse = cosine_lobes(cube.directions, np.random.default_rng(5), 2)
    off = truth - coarse @ projection.matrix @ basis.reconstruction_matrix(fine.directions).T
    assert np.sum(off**2 @ fine.weights) > 0.05 * np.sum(truth**2 @ fine.weights)


def test_equal_and_antipodal_centres_of_a_narrow_pair():
    assert gaussian_product_integral(1e6, 1e6, 1.0) == pytest.approx(np.pi / 1e6, rel=1e-12)
    assert gaussian_product_integral(1e-6, 1e-6, -1.0) == pytest.approx(4 * np.pi, rel=3e-6)
    assert gaussian_product_integral(500.0, 500.0, -1.0) == 4 * np.pi * np.exp(-1000.0)
    assert gaussian(-1.0, 1e6) == 0.0
