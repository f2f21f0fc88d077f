import numpy as np
import pytest

from prtbake_workers.brdf.checks import check_energy, directional_albedo
from prtbake_workers.brdf.lafortune import Lafortune, Lobe
from prtbake_workers.brdf.phong import Phong

GREY = np.array([0.0])
ONE = np.array([1.0])


@pytest.mark.parametrize("exponent", [1.0, 30.0])
def test_the_mirror_lobe_is_phong(directions, exponent):
    wi, wo = directions(200), directions(200, seed=2)
    kd, ks = np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.4, 0.3])
    weight = ks * (exponent + 2) / (2 * np.pi)
    got = Lafortune(kd, (Lobe(weight, (-1.0, -1.0, 1.0), exponent),)).eval_brdf(wi, wo)
    np.testing.assert_allclose(got, Phong(kd, ks, exponent).eval_brdf(wi, wo), rtol=1e-12)
    # twin: one flipped sign
    other = Lafortune(kd, (Lobe(weight, (-1.0, 1.0, 1.0), exponent),)).eval_brdf(wi, wo)
    assert np.abs(other - got).max() > 0.01


@pytest.mark.parametrize(("cz", "exponent"), [(1.0, 7.0), (0.8, 3.0), (1.05, 30.0)])
def test_albedo_at_normal_light_is_a_closed_form(cz, exponent):
    """weight cz^n 2 pi / (n + 2), whatever cx and cy are."""
    lobe = Lobe(np.array([0.2]), (-0.3, 0.9, cz), exponent)
    got = directional_albedo(Lafortune(GREY, (lobe,)), ONE)[0, 0]
    np.testing.assert_allclose(got, 0.2 * cz**exponent * 2 * np.pi / (exponent + 2), rtol=1e-10)


def test_lobes_add_up(directions):
    wi, wo = directions(50), directions(50, seed=2)
    lobes = (Lobe(ONE, (-1.0, -1.0, 1.0), 5.0), Lobe(0.5 * ONE, (1.0, 0.4, 0.7), 9.0))
    whole = Lafortune(GREY, lobes).eval_brdf(wi, wo)
    single = [Lafortune(GREY, (lobe,)).eval_brdf(wi, wo) for lobe in lobes]
    np.testing.assert_allclose(whole, single[0] + single[1], rtol=1e-14)
    assert (single[1] > 0).any()


def test_off_specular_peak_leans_to_the_horizon():
    """cz < |cx|: the peak stands lower than the mirror direction, as on rough surfaces."""
    lobe = Lafortune(GREY, (Lobe(ONE, (-1.0, -1.0, 0.6), 20.0),))
    angles = np.linspace(0.0, 1.55, 400)
    wo = np.stack([-np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    wi = np.array([[np.sin(0.7), 0.0, np.cos(0.7)]])
    peak = angles[lobe.eval_brdf(wi, wo)[:, 0].argmax()]
    assert peak == pytest.approx(np.arctan(np.tan(0.7) / 0.6), abs=0.005)


def test_a_lobe_is_dark_on_its_far_side_whatever_the_exponent():
    lobe = Lafortune(GREY, (Lobe(ONE, (-1.0, -1.0, 0.0), 0.0),))
    wi = np.array([[0.6, 0.0, 0.8]])
    assert lobe.eval_brdf(wi, wi)[0, 0] == 0.0
    assert lobe.eval_brdf(wi, wi * [-1, 1, 1])[0, 0] == 1.0


def test_isotropy_is_read_from_every_lobe():
    even, odd = Lobe(ONE, (-1.0, -1.0, 1.0), 5.0), Lobe(ONE, (-1.0, -0.9, 1.0), 5.0)
    assert Lafortune(GREY, (even, even)).is_isotropic
    assert not Lafortune(GREY, (even, odd)).is_isotropic


def test_too_heavy_a_lobe_is_found_out():
    lobe = Lobe(np.array([7 / (2 * np.pi)]), (-1.0, -1.0, 1.1), 5.0)
    assert not check_energy(Lafortune(GREY, (lobe,)), n_angles=5).conserves
