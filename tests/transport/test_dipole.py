"""The dipole beside quadrature, published reflectances and its own closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from prtbake_storage.errors import SettingsError
from prtbake_workers.transport.diffuse_fresnel import (
    entering_transmittance,
    internal_reflectance,
)
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.scattering_media import MEASURED_MEDIA

PUBLISHED = {
    "apple": (0.85, 0.84, 0.53),
    "chicken1": (0.31, 0.15, 0.10),
    "chicken2": (0.32, 0.16, 0.10),
    "cream": (0.98, 0.90, 0.73),
    "ketchup": (0.16, 0.01, 0.00),
    "marble": (0.83, 0.79, 0.75),
    "potato": (0.77, 0.62, 0.21),
    "skim_milk": (0.81, 0.81, 0.69),
    "skin1": (0.44, 0.22, 0.13),
    "skin2": (0.63, 0.44, 0.34),
    "spectralon": (1.00, 1.00, 1.00),
    "whole_milk": (0.91, 0.88, 0.76),
}
"""The column "diffuse reflectance" of figure 5 of Jensen et al. 2001."""


def grey(scattering, absorption, eta=1.3):
    return Dipole(np.array([scattering]), np.array([absorption]), eta)


def by_hand(r, scattering, absorption, eta):
    """R_d as the field flux of two point sources, written out apart from the code."""
    total = scattering + absorption
    tr = np.sqrt(3 * absorption * total)
    fdr = -1.440 / eta**2 + 0.710 / eta + 0.668 + 0.0636 * eta
    zr, zv = 1 / total, (1 + 4 / 3 * (1 + fdr) / (1 - fdr)) / total
    value = 0.0
    for z in (zr, zv):
        d = np.sqrt(r * r + z * z)
        value += z * (tr + 1 / d) * np.exp(-tr * d) / d**2
    return scattering / total * value / (4 * np.pi)


def over_plane(profile, unit):
    """Integrate 2 pi r f(r) dr in r = unit e^t."""
    value, _ = quad(
        lambda t: 2 * np.pi * (unit * np.exp(t)) ** 2 * profile(unit * np.exp(t)),
        -25, 25, limit=400, epsabs=1e-13, epsrel=1e-11,
    )  # fmt: skip
    return value


@pytest.mark.parametrize("eta", [1.0, 1.1, 1.3, 1.5, 2.0, 2.5])
def test_fresnel_terms_equal_the_integral(eta):
    def reflected(mu, ratio):
        """Unpolarised Fresnel reflectance, the second medium ratio times as dense."""
        squared = 1 - (1 - mu * mu) / ratio**2
        if squared <= 0:
            return 1.0
        other = np.sqrt(squared)
        return 0.5 * (
            ((mu - ratio * other) / (mu + ratio * other)) ** 2
            + ((ratio * mu - other) / (ratio * mu + other)) ** 2
        )

    critical = np.sqrt(max(0.0, 1 - 1 / eta**2))
    inside = quad(lambda mu: 2 * mu * reflected(mu, 1 / eta), 0, 1, points=[critical], limit=200)[0]
    outside = quad(lambda mu: 2 * mu * reflected(mu, eta), 0, 1, limit=200)[0]
    # the rational fit's own error, largest at the two ends
    assert internal_reflectance(eta) == pytest.approx(inside, abs=5.5e-3 if eta > 2 else 1.7e-3)
    # quadrature of a function that is smooth but for its ends
    assert entering_transmittance(eta) == pytest.approx(1 - outside, abs=1e-9)
    if eta > 1:
        # negative twin: inside and outside differ by eta^2
        assert abs(entering_transmittance(eta) - (1 - internal_reflectance(eta))) > 0.1


@pytest.mark.parametrize("eta", [0.99, 2.6, np.nan])
def test_an_index_out_of_range_is_refused(eta):
    with pytest.raises(SettingsError, match="eta"):
        grey(1.0, 0.1, eta)


def test_profile_equals_two_sources_written_out():
    r = np.geomspace(1e-3, 30, 40)
    found = Dipole(np.array([0.74, 0.88, 1.01]), np.array([0.032, 0.17, 0.48]), 1.3).profile(r)
    for channel, (s, a) in enumerate(zip((0.74, 0.88, 1.01), (0.032, 0.17, 0.48), strict=True)):
        np.testing.assert_allclose(found[channel], by_hand(r, s, a, 1.3), rtol=1e-12)


@pytest.mark.parametrize(
    ("scattering", "absorption", "eta"),
    [(2.19, 0.0021, 1.5), (0.74, 0.032, 1.3), (1.0, 0.0, 1.3), (0.03, 1.45, 1.3), (1.0, 1.0, 1.0)],
)
def test_total_reflectance_is_the_profile_over_the_plane(scattering, absorption, eta):
    dipole = grey(scattering, absorption, eta)

    def value(r):
        return dipole.profile(np.array([r]))[0, 0]

    # without absorption the part beyond e^25 paths is 1e-10
    total = over_plane(value, 1 / (scattering + absorption))
    assert dipole.total_reflectance[0] == pytest.approx(total, abs=1e-9)
    if absorption > 0.0:
        # negative twin: both sources at the depth of the real one
        wrong = dipole.albedo[0] * np.exp(-dipole.decay[0] * dipole.mean_free_path[0])
        assert abs(wrong - total) > 1e-3


def test_published_reflectances_come_out():
    """They are of the same formula, printed with two digits."""
    assert set(PUBLISHED) == set(MEASURED_MEDIA)
    for name, expected in PUBLISHED.items():
        found = Dipole.of_material(name, mm_per_unit=1.0).total_reflectance
        # two digits and rounded coefficients; one entry of the paper is off by 0.026
        atol = 0.03 if name == "chicken1" else 0.0105
        np.testing.assert_allclose(found, expected, atol=atol)
    # negative twin: marble at the index of the others
    marble = MEASURED_MEDIA["marble"]
    wrong = Dipole(marble.scattering, marble.absorption, 1.3).total_reflectance
    assert np.abs(wrong - PUBLISHED["marble"]).max() > 0.03


@pytest.mark.parametrize("absorption", [0.0, 0.02, 2.0])
def test_disc_reflectance_is_the_profile_over_the_disc(absorption):
    dipole = grey(1.0, absorption)
    for radius in (0.01, 0.3, 2.0, 40.0):
        value, _ = quad(
            lambda r: 2 * np.pi * r * dipole.profile(np.array([r]))[0, 0],
            0, radius, points=[min(1.0, radius / 2)], limit=200, epsrel=1e-12,
        )  # fmt: skip
        assert dipole.disc_reflectance(np.array([radius]))[0, 0] == pytest.approx(value, rel=1e-10)


def test_a_tiny_disc_keeps_its_digits():
    """The difference of two antiderivatives would be rounding; R_d(0) times the area is right."""
    dipole = grey(1.0, 0.1)
    for radius in (1e-3, 1e-6, 1e-9, 1e-12):
        area = np.pi * radius**2
        expected = area * dipole.profile(np.zeros(1))[0, 0]
        # next order: (radius / path)^2
        found = dipole.disc_reflectance(np.array([radius]))[0, 0]
        assert found == pytest.approx(expected, rel=max(10 * radius**2, 1e-12))


@pytest.mark.parametrize("absorption", [0.0, 0.01, 3.0])
@pytest.mark.parametrize("share", [0.5, 0.99])
def test_the_extent_holds_its_share(absorption, share):
    dipole = grey(2.0, absorption)
    radius = dipole.extent(share)
    assert dipole.disc_reflectance(radius)[0, 0] == pytest.approx(
        share * dipole.total_reflectance[0], rel=1e-9
    )
    assert (
        dipole.disc_reflectance(1.1 * radius)[0, 0] > 1.0005 * share * dipole.total_reflectance[0]
    )


def test_a_share_outside_its_range_is_refused():
    for share in (0.0, 1.0):
        with pytest.raises(SettingsError, match="share"):
            grey(1.0, 0.1).extent(share)


def test_average_over_a_patch_is_of_second_order():
    """Halving the patch divides the error by 2^4 = 16; without its covariance by 2^2."""
    dipole = grey(1.0, 0.05)
    g, w = np.polynomial.legendre.leggauss(24)
    u, v = np.meshgrid(g, g, indexing="ij")
    weights = np.outer(w, w).ravel() / 4
    away = np.array([1.2, 0.7, 0.9])
    errors, plain = [], []
    for size in (0.4, 0.2, 0.1):
        axes = size * np.array([[1.0, 0.2, 0.0], [0.1, 0.6, 0.5]])
        points = np.stack([u.ravel(), v.ravel()], 1) @ axes
        exact = weights @ dipole.profile(np.linalg.norm(away - points, axis=1))[0]
        spread = axes.T @ axes / 3
        errors.append(abs(dipole.profile_over(away[None], spread[None])[0, 0] / exact - 1))
        plain.append(abs(dipole.profile(np.linalg.norm(away[None], axis=1))[0, 0] / exact - 1))
    assert errors[0] / errors[1] > 12
    assert errors[1] / errors[2] > 12
    assert errors[2] < 1e-4
    assert plain[2] > 10 * errors[2]


def test_no_patch_sends_less_than_nothing():
    """A patch far wider than the mean free path: the second order alone would be negative."""
    dipole = grey(1.0, 5.0)
    near = np.array([[0.05, 0.0, 0.0]])
    flat = np.diag([0.0, 0.04, 0.04])[None]
    distance = np.array([1e-4, 0.05])
    slope = np.diff(dipole.profile(distance)[0]) / np.diff(distance) / 0.05
    assert dipole.profile(distance)[0, 1] + 0.5 * 0.08 * 20 * slope[0] < 0.0
    assert dipole.profile_over(near, 20 * flat)[0, 0] == 0.0
    assert dipole.profile_over(near, 1e-3 * flat)[0, 0] > 0.0


def test_a_patch_without_size_is_the_profile():
    dipole = Dipole.of_material("skin1", mm_per_unit=1.0)
    away = np.array([[0.0, 0.0, 0.0], [0.3, -0.4, 1.2]])
    found = dipole.profile_over(away, np.zeros((2, 3, 3)))
    np.testing.assert_allclose(found, dipole.profile(np.array([0.0, 1.3])), rtol=1e-12)


@given(scale=st.floats(1e-12, 1e12), absorption=st.floats(0.0, 10.0))
def test_units_do_not_matter(scale, absorption):
    """R_d is per area: a unit s times as long divides it by s^2."""
    one, other = grey(1.0, absorption), grey(1.0 * scale, absorption * scale)
    np.testing.assert_allclose(other.total_reflectance, one.total_reflectance, rtol=1e-9)
    r = np.array([0.0, 0.1, 1.0, 7.0])
    np.testing.assert_allclose(
        other.profile(r / scale) / scale**2, one.profile(r), rtol=1e-9, atol=1e-300
    )
    np.testing.assert_allclose(other.extent() * scale, one.extent(), rtol=1e-6)


def test_millimetres_are_scaled():
    per_mm = Dipole.of_material("marble", mm_per_unit=1.0)
    per_metre = Dipole.of_material("marble", mm_per_unit=1000.0)
    np.testing.assert_allclose(per_metre.mean_free_path, per_mm.mean_free_path / 1000.0)
    for scale in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(SettingsError, match="mm_per_unit"):
            Dipole.of_material("marble", mm_per_unit=scale)


def test_an_unknown_material_is_named():
    with pytest.raises(SettingsError, match=r"'jade'.*marble"):
        Dipole.of_material("jade", mm_per_unit=1.0)


def test_zero_scattering_is_black_and_zero_absorption_loses_nothing():
    assert grey(0.0, 1.0).total_reflectance[0] == 0.0
    assert grey(0.0, 1.0).extent()[0] == 0.0
    assert not grey(0.0, 1.0).profile(np.array([0.0, 1.0])).any()
    assert grey(1.0, 0.0).total_reflectance[0] == 1.0


@pytest.mark.parametrize(
    ("scattering", "absorption", "message"),
    [
        ([0.0], [0.0], "both zero"),
        ([-1.0], [1.0], "scattering must be"),
        ([1.0], [np.inf], "absorption must be"),
        ([1.0, 1.0], [1.0, 1.0], "one channel or three"),
    ],
)
def test_coefficients_that_mean_nothing_are_refused(scattering, absorption, message):
    with pytest.raises(SettingsError, match=message):
        Dipole(np.array(scattering), np.array(absorption), 1.3)
