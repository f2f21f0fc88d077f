import numpy as np
import pytest
from scipy.integrate import dblquad

from prtbake_storage.contract.brdf import (
    BlinnPhongSpec,
    CookTorranceSpec,
    GgxSpec,
    LafortuneLobe,
    LafortuneSpec,
    PhongSpec,
    WardSpec,
)
from prtbake_workers.brdf.base import above_horizon
from prtbake_workers.brdf.checks import (
    check_energy,
    check_factorisation,
    check_reciprocity,
    directional_albedo,
)
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec


class Scaled:
    """A model times a number, to break what it keeps."""

    n_channels = 1

    def __init__(self, brdf, factor):
        self.brdf, self.factor = brdf, factor

    def eval_brdf(self, wi, wo):
        return self.factor * self.brdf.eval_brdf(wi, wo)


class OneSided:
    """Not reciprocal: it depends on the light alone."""

    n_channels = 1

    def eval_brdf(self, wi, wo):
        return np.where(above_horizon(wi, wo), wi[..., 2], 0.0)[..., None]


@pytest.mark.parametrize(
    "spec",
    [
        PhongSpec(exponent=1.0),
        BlinnPhongSpec(exponent=10.0),
        CookTorranceSpec(kd=0.0, ks=1.0, m=0.3, f0=1.0),
        GgxSpec(alpha=0.2, f0=1.0),
    ],
)
def test_white_surfaces_reach_but_do_not_pass_one(spec):
    brdf = brdf_from_spec(spec)
    report = check_energy(brdf, n_angles=9)
    assert report.conserves
    assert 0.99 < report.max_albedo < 1 + 1e-5
    assert not check_energy(Scaled(brdf, 1.01), n_angles=9).conserves
    assert set(report.to_dict()) == {"max_albedo", "cos_at_max", "normal_albedo", "conserves"}


def test_diffuse_and_specular_may_add_up_to_too_much():
    assert not check_energy(brdf_from_spec(PhongSpec(kd=0.6, ks=0.6)), n_angles=5).conserves


def test_grazing_light_is_integrated_too():
    """A GGX surface with F = 1 turns into a mirror at the horizon: albedo 1 - O(cos)."""
    albedo = directional_albedo(brdf_from_spec(GgxSpec(alpha=0.1, f0=1.0)), np.array([1e-6, 1e-4]))
    assert (np.abs(1 - albedo[:, 0]) < [1e-4, 1e-2]).all()
    assert (albedo < 1 + 1e-6).all()


@pytest.mark.parametrize("azimuth", [0.0, 0.6, np.pi / 2])
def test_an_anisotropic_lobe_is_integrated_at_every_azimuth(azimuth):
    """Against a plain midpoint rule, which resolves lobes as wide as this."""
    brdf = brdf_from_spec(WardSpec(alpha_x=0.5, alpha_y=0.2))
    cosine = 0.6
    z = (np.arange(400) + 0.5)[:, None] / 400
    phi = 2 * np.pi * (np.arange(400) + 0.5) / 400
    s = np.sqrt(1 - z * z)
    wo = np.stack(np.broadcast_arrays(s * np.cos(phi), s * np.sin(phi), z), axis=-1)
    wi = np.array([0.8 * np.cos(azimuth), 0.8 * np.sin(azimuth), cosine])[None, None]
    plain = np.sum(brdf.eval_brdf(wi, wo)[..., 0] * z) * 2 * np.pi / 400**2
    got = directional_albedo(brdf, np.array([cosine]), azimuth=azimuth)[0, 0]
    # the midpoint rule of step 1 / 400 at the horizon, where the integrand ends
    assert got == pytest.approx(plain, rel=1e-4)
    other = directional_albedo(brdf, np.array([cosine]), azimuth=azimuth + 0.7)[0, 0]
    assert abs(other / plain - 1) > 1e-3


def test_a_lobe_off_the_mirror_direction_is_resolved():
    """(cz wo.z)^n at normal light, and its pull to the normal elsewhere: against scipy's rule."""
    lobe = LafortuneLobe(weight=100.0, cx=-0.4, cy=-0.4, cz=1.0, exponent=3000.0)
    brdf = brdf_from_spec(LafortuneSpec(lobes=(lobe,)))

    def integrand(phi, z):
        s = np.sqrt(1 - z * z)
        wo = np.array([s * np.cos(phi), s * np.sin(phi), z])
        return brdf.eval_brdf(np.array([[0.6, 0.0, 0.8]]), wo[None])[0, 0] * z

    # the peak: tan theta_o = 0.4 tan theta_i
    top = 1 / np.hypot(1, 0.3)
    plain = dblquad(integrand, top - 0.06, 1.0, np.pi - 0.4, np.pi, epsabs=1e-22)[0] * 2
    got = directional_albedo(brdf, np.array([0.8]))[0, 0]
    assert got == pytest.approx(plain, rel=1e-6)


def test_reciprocity_tells_both_kinds_apart():
    assert check_reciprocity(brdf_from_spec(CookTorranceSpec())).max_relative == 0.0
    report = check_reciprocity(OneSided())
    assert not report.reciprocal
    assert report.to_dict()["max_relative"] > 0.5


@pytest.mark.parametrize("m", [0.5, 0.3])
def test_the_error_off_the_grid_is_the_energy_lost(m):
    brdf = brdf_from_spec(CookTorranceSpec(m=m))
    found = factorise(brdf, n_terms=16)
    report = check_factorisation(brdf, found, n_theta=41, n_phi=160)
    # the grid's own error, 8 % of the figure at m 0.3
    assert report.relative_error == pytest.approx(found.energy_lost, rel=0.12)
    assert report.tabulation < 1e-8
    # twin: the terms of another BRDF
    other = factorise(brdf_from_spec(CookTorranceSpec(m=2 * m)), n_terms=16)
    wrong = check_factorisation(brdf, other, n_theta=31, n_phi=120)
    assert wrong.relative_error > 1.5 * report.relative_error


def test_the_error_falls_to_nothing_with_the_terms():
    brdf = brdf_from_spec(PhongSpec(kd=0.3, ks=0.7, exponent=5.0))
    errors = [
        check_factorisation(brdf, factorise(brdf, n_terms=k), n_theta=25, n_phi=64).relative_error
        for k in (1, 9, 35)
    ]
    assert errors[0] > 10 * errors[1] > 100 * errors[2]


def test_a_coarse_table_shows():
    brdf = brdf_from_spec(CookTorranceSpec())
    coarse = factorise(brdf, n_terms=16, n_nodes=17)
    assert check_factorisation(brdf, coarse, n_theta=31, n_phi=64).tabulation > 1e-6
