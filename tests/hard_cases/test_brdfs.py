"""Grazing, normal, equal and opposite directions, in every BRDF and at the ends of its range."""

import numpy as np
import pytest

from prtbake_storage.contract.brdf import (
    BlinnPhongSpec,
    CookTorranceSpec,
    GgxSpec,
    LafortuneLobe,
    LafortuneSpec,
    LambertSpec,
    OrenNayarSpec,
    PhongSpec,
    WardSpec,
)
from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.base import COSINE_FLOOR
from prtbake_workers.brdf.checks import check_energy, check_reciprocity, directional_albedo
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.half_difference import directions_of
from prtbake_workers.brdf.half_difference_table import bin_angles
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.merl import read_merl
from prtbake_workers.brdf.oriented_checks import measure_loss
from prtbake_workers.brdf.registry import brdf_from_spec
from support.merl_file import COLOURED, coloured_samples, merl_bytes

EXTREMES = {
    "lambert_black": LambertSpec(albedo=0.0),
    "lambert_white": LambertSpec(albedo=1.0),
    "phong_flat": PhongSpec(exponent=1.0),
    "phong_sharp": PhongSpec(exponent=10_000.0),
    "blinn_phong_flat": BlinnPhongSpec(exponent=1.0),
    "blinn_phong_sharp": BlinnPhongSpec(exponent=10_000.0),
    "cook_torrance_smooth": CookTorranceSpec(m=0.01),
    "cook_torrance_rough": CookTorranceSpec(m=2.0),
    "cook_torrance_white": CookTorranceSpec(kd=0.0, ks=1.0, m=0.1, f0=1.0),
    "cook_torrance_no_f0": CookTorranceSpec(kd=0.0, ks=1.0, m=0.5, f0=0.0),
    "cook_torrance_coloured": CookTorranceSpec(kd=0.0, ks=1.0, m=0.01, f0=(1.0, 0.8, 0.0)),
    "ggx_smooth": GgxSpec(alpha=0.01, f0=1.0),
    "ggx_rough": GgxSpec(alpha=1.0, f0=1.0),
    "oren_nayar_flat": OrenNayarSpec(sigma=0.0),
    "oren_nayar_rough": OrenNayarSpec(sigma=np.pi / 2),
    "ward_smooth": WardSpec(alpha_x=0.01, alpha_y=0.01),
    "ward_rough": WardSpec(alpha_x=1.0, alpha_y=1.0),
    "lafortune_sharp": LafortuneSpec(lobes=(LafortuneLobe(weight=1500.0, exponent=10_000.0),)),
    "lafortune_retro": LafortuneSpec(
        kd=0.2, lobes=(LafortuneLobe(weight=5.0, cx=1.0, cy=1.0, exponent=60.0),)
    ),
}
ANISOTROPIC = {
    "ward_brushed": WardSpec(alpha_x=0.01, alpha_y=1.0),
    "ward_nearly_isotropic": WardSpec(kd=0.5, ks=0.5, alpha_x=0.01, alpha_y=0.02),
    "lafortune_brushed": LafortuneSpec(
        lobes=(LafortuneLobe(weight=30.0, cx=-1.0, cy=-0.2, exponent=200.0),)
    ),
    "lafortune_split": LafortuneSpec(
        lobes=(
            LafortuneLobe(weight=0.2, exponent=1.0),
            LafortuneLobe(weight=2.0, cx=1.0, cy=-1.0, exponent=20.0),
        )
    ),
}
TOO_NARROW = "cook_torrance_smooth"
NEEDLE = "ward_nearly_isotropic"
TINY = [1e-300, 1e-30, 1e-12, COSINE_FLOOR, 1e-4, 1e-2]


def at(cos, phi=0.0):
    cos = np.asarray(cos, np.float64)
    sine = np.sqrt(1 - cos * cos)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), cos], axis=-1)


@pytest.fixture(params=EXTREMES)
def brdf(request):
    return brdf_from_spec(EXTREMES[request.param])


@pytest.fixture(params=EXTREMES | ANISOTROPIC)
def any_brdf(request):
    return brdf_from_spec((EXTREMES | ANISOTROPIC)[request.param])


def finite_and_not_negative(value):
    return bool(np.isfinite(value).all() and (value >= 0.0).all())


def test_grazing_light_and_grazing_view(any_brdf):
    brdf = any_brdf
    cosines = np.array([*TINY, 0.3, 0.9, 1.0])
    for phi in (0.0, 1e-9, 1.0, np.pi / 2, np.pi - 1e-9, np.pi):
        value = brdf.eval_brdf(at(cosines)[:, None], at(cosines, phi)[None])
        assert finite_and_not_negative(value)
        # what a pixel or a vertex sees carries the cosines: bounded by the largest lobe there is
        radiance = value * cosines[:, None, None] * cosines[:, None]
        assert radiance.max() < 4e3
    assert finite_and_not_negative(value.astype(np.float32))


def test_normal_incidence_and_normal_view(brdf):
    up = at([1.0])
    assert finite_and_not_negative(brdf.eval_brdf(up, up))
    around = at(np.linspace(0.01, 1, 50))
    turned = at(np.linspace(0.01, 1, 50), 2.0)
    # at normal incidence the azimuth does not exist
    np.testing.assert_allclose(brdf.eval_brdf(up, around), brdf.eval_brdf(up, turned), rtol=1e-9)


def test_equal_directions(any_brdf):
    wi = at([*TINY, 0.5, 1.0])
    assert finite_and_not_negative(any_brdf.eval_brdf(wi, wi))


def test_opposite_directions(any_brdf):
    """On the horizon the half vector vanishes; off it one of the two lies below."""
    brdf = any_brdf
    horizon = np.array([[1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    assert not brdf.eval_brdf(horizon, -horizon).any()
    # nothing but rounding keeps these two from being opposite
    above = at([1e-300, 1e-17])
    assert finite_and_not_negative(brdf.eval_brdf(above, at([1e-300, 1e-17], np.pi)))
    wi = at([0.5, 1.0])
    assert not brdf.eval_brdf(wi, -wi).any()


def test_at_and_below_the_horizon_nothing(any_brdf):
    brdf = any_brdf
    up, edge = at([0.3, 1.0]), at([0.0, 0.0], 1.0)
    for down in (edge, -edge, at([-1e-300, -0.5], 1.0), at([-1.0, -1e-6], 1.0)):
        assert not brdf.eval_brdf(up, down).any()
        assert not brdf.eval_brdf(down, up).any()


def test_every_extreme_but_black_has_its_mirror_peak(brdf):
    """Twin of the zeros above: they are not there because nothing reflects."""
    mirrored = brdf.eval_brdf(at([1e-3, 0.3, 0.8]), at([1e-3, 0.3, 0.8], np.pi))
    black = isinstance(brdf, Lambert) and not brdf.albedo.any()
    assert (mirrored.max(axis=1) > 0).all() != black


def test_extremes_are_reciprocal_and_create_no_light(any_brdf):
    assert check_reciprocity(any_brdf, n_pairs=500).reciprocal
    report = check_energy(any_brdf, n_angles=5)
    assert report.conserves
    assert np.isfinite(report.max_albedo)


def test_the_narrowest_lobe_is_refused_where_its_terms_are_worse_than_none():
    with pytest.raises(BrdfError, match="too narrow"):
        factorise(brdf_from_spec(EXTREMES[TOO_NARROW]), n_terms=16, n_nodes=33)


@pytest.mark.parametrize("name", [name for name in EXTREMES if name != TOO_NARROW])
def test_extremes_factorise(name):
    found = factorise(brdf_from_spec(EXTREMES[name]), n_terms=16, n_nodes=33)
    w = np.concatenate([at(TINY), at([0.0, -0.5, 0.5, 1.0], 1.0), at(TINY, 3.0)])
    for side in (found.eval_psi, found.eval_phi, found.eval_psi_exact, found.eval_phi_exact):
        value = side(w)
        assert np.isfinite(value).all()
        assert not value[w[:, 2] <= 0].any()
    fast = found.psi_lookup(*w.astype(np.float32).T.copy())
    assert np.isfinite(fast).all()
    assert np.isfinite(found.singular_values).all()
    assert 0.0 <= found.energy_lost < 1.0


def test_an_anisotropic_lobe_between_the_nodes_is_refused():
    with pytest.raises(BrdfError, match="too narrow"):
        factorise(brdf_from_spec(ANISOTROPIC[NEEDLE]), n_terms=16, n_theta=10, n_phi=40)


@pytest.mark.parametrize("name", [name for name in ANISOTROPIC if name != NEEDLE])
def test_anisotropic_extremes_factorise(name):
    """On a coarse grid: what falls between its nodes is measured, and a figure stated stands."""
    brdf = brdf_from_spec(ANISOTROPIC[name])
    found = factorise(brdf, n_terms=16, n_theta=10, n_phi=40)
    w = np.concatenate([at(TINY), at([0.0, -0.5, 0.5, 1.0], 1.0), at(TINY, 3.0)])
    for side in (found.eval_psi, found.eval_phi, found.eval_psi_exact, found.eval_phi_exact):
        value = side(w)
        assert np.isfinite(value).all()
        assert not value[w[:, 2] <= 0].any()
    assert np.isfinite(found.psi_lookup(*w.astype(np.float32).T.copy())).all()
    lost, _ = measure_loss(brdf, found)
    assert 0.5 * lost < found.energy_lost <= 1.0


@pytest.mark.parametrize("exponent", [1.0, 60.0, 10_000.0])
def test_a_retro_reflector_sends_light_back(exponent):
    """It is Phong's lobe with the view turned half round: the same albedo, the other peak."""
    weight = (exponent + 2.0) / (2.0 * np.pi)
    lobe = LafortuneLobe(weight=weight, cx=1.0, cy=1.0, exponent=exponent)
    retro = brdf_from_spec(LafortuneSpec(lobes=(lobe,)))
    wi = at([0.3, 0.8])
    np.testing.assert_allclose(retro.eval_brdf(wi, wi)[:, 0], weight, rtol=1e-10)
    assert (retro.eval_brdf(wi, at([0.3, 0.8], np.pi))[:, 0] < 0.8 * weight).all()
    cosines = np.array([0.05, 0.4, 0.9])
    phong = directional_albedo(brdf_from_spec(PhongSpec(exponent=exponent)), cosines)
    # the nodes crowd less towards the light than towards the mirror direction
    np.testing.assert_allclose(directional_albedo(retro, cosines), phong, rtol=1e-6)
    assert factorise(retro, n_terms=16, n_nodes=33).energy_lost < 1.0


def test_rough_white_cavities_create_light_at_grazing_incidence_and_it_is_reported():
    """A + B / 2, at most 1.0152: the model's own fault, for the report to name."""
    report = check_energy(brdf_from_spec(OrenNayarSpec(sigma=0.21)), n_angles=9)
    assert not report.conserves
    assert 1.0140 < report.max_albedo < 1.0155
    assert report.cos_at_max == COSINE_FLOOR
    assert check_energy(
        brdf_from_spec(OrenNayarSpec(albedo=0.98, sigma=0.21)), n_angles=5
    ).conserves


@pytest.fixture(scope="module")
def holed():
    """A MERL table with samples of -1: below the horizon, in a block, and in one channel."""
    samples = coloured_samples().copy()
    samples[:, 30:34, 10:16, :] = -1.0
    samples[2, 50, 30, 100] = -1.0
    return read_merl(merl_bytes(samples))


def test_merl_samples_of_minus_one_are_counted(holed):
    _, report = holed
    n_below = int((coloured_samples().min(axis=0) < 0).sum())
    assert report.n_invalid_above_horizon == 4 * 6 * 180 + 1
    assert report.n_invalid == n_below + 4 * 6 * 180 + 1
    assert report.most_negative == pytest.approx(-1.66 / 1500)


def test_merl_samples_of_minus_one_never_become_light(holed):
    table, _ = holed
    assert (table.values >= 0.0).all()
    angles = bin_angles(90, 90, 90)
    wi, wo = directions_of(
        angles.theta_h[30:34], angles.theta_d[10:16], np.broadcast_to(angles.phi_d, (4, 6, 90))
    )
    filled, model = table.eval_brdf(wi, wo), brdf_from_spec(COLOURED).eval_brdf(wi, wo)
    # the nearest valid bins are at most three away, where the lobe falls by a fifth a bin
    assert (filled > 0.0).all()
    assert np.abs(filled / model - 1).max() < 0.6
    # twin: left as they were, or set to nothing, they would be far off
    assert np.abs(0.0 / model - 1).min() == 1.0


def test_grazing_light_on_a_merl_table(holed):
    table, _ = holed
    cosines = np.array([*TINY, 0.3, 0.9, 1.0])
    for phi in (0.0, 1e-9, 1.0, np.pi / 2, np.pi):
        value = table.eval_brdf(at(cosines)[:, None], at(cosines, phi)[None])
        assert finite_and_not_negative(value)
        assert value.max() <= table.values.max() * (1 + 1e-6)  # float32
    assert not table.eval_brdf(at([0.5]), at([0.0, -0.5])).any()


def test_a_merl_table_factorises_and_creates_no_light(holed):
    table, _ = holed
    assert check_reciprocity(table, n_pairs=500).max_relative == 0.0
    assert check_energy(table, n_angles=5).conserves
    found = factorise(table, n_terms=16, n_nodes=33)
    assert np.isfinite(found.eval_phi_exact(at(TINY))).all()
    assert 0.0 < found.energy_lost < 0.2
