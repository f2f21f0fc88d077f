"""Views in hemispherical harmonics, against the library's glossy matrix and dense sums."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prtbake_storage.contract.brdf import CookTorranceSpec, LambertSpec, PhongSpec, WardSpec
from prtbake_storage.errors import BrdfError, SettingsError
from prtbake_workers.basis.sh import HemisphereBasis, eval_sh, glossy_matrix
from prtbake_workers.brdf.checks import check_factorisation
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.factorise_harmonic import factorise_harmonic
from prtbake_workers.brdf.harmonic_factorisation import HarmonicFactorisation
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from support.quadrature import hemisphere_quadrature

ORDER = 5
GREY = PhongSpec(kd=0.3, ks=0.7, exponent=10)
COLOURED = PhongSpec(kd=(0.3, 0.1, 0.5), ks=0.7, exponent=10)
"""Smooth up to the horizon: quadratures of it converge."""


@pytest.fixture(scope="module")
def rule():
    return hemisphere_quadrature(32)


@pytest.fixture(scope="module")
def exitant():
    return HemisphereBasis(ORDER)


@pytest.fixture(scope="module")
def grey(exitant):
    return factorise_harmonic(brdf_from_spec(GREY), ORDER, exitant.kept)


@pytest.fixture(scope="module")
def coloured(exitant):
    return factorise_harmonic(brdf_from_spec(COLOURED), ORDER, exitant.kept)


def summed(found, wi, wo):
    return np.einsum("ik,okc->ioc", found.eval_psi_exact(wi), found.eval_phi_exact(wo))


def test_an_unoccluded_vertex_has_the_library_s_glossy_matrix(grey, exitant, rule, rng):
    """Sum of psi_k cos on the light, times phi_k, is A^-1 B A^-1 R T, whatever the frame."""
    directions, weights = rule
    n_light = 4
    incident = HemisphereBasis(n_light, tolerance=0.0)  # holds the light where T has no shadow
    brdf = brdf_from_spec(GREY).eval_brdf(directions[:, None], directions[None])[..., 0]
    y_out = weights[:, None] * eval_sh(ORDER, directions)
    y_in = (weights * directions[:, 2])[:, None] * eval_sh(n_light, directions)
    views = directions[::37]
    for frame in Rotation.random(3, rng=rng).as_matrix():
        y_light = eval_sh(n_light, directions @ frame)
        seen = (weights[:, None] * y_light).T @ y_light
        matrix = glossy_matrix(
            y_out.T @ brdf.T @ y_in, seen, frame, incident=incident, exitant=exitant
        )
        expected = exitant.evaluate(views) @ matrix
        transfer = grey.eval_psi_exact(directions).T @ (
            (weights * directions[:, 2])[:, None] * y_light
        )
        found = grey.eval_phi_exact(views)[..., 0] @ transfer
        # 1e-10 of the largest: rounding times the condition of the bases, 1e-12 measured
        tolerance = 1e-10 * np.abs(expected).max()
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
        # negative twins: rows without A^-1, and the same number of terms by SVD
        plain = eval_sh(ORDER, views) @ (y_out.T @ brdf.T @ y_in) @ incident.inverse_gram @ seen
        assert np.abs(plain - expected).max() > 1e6 * tolerance
        best = factorise(brdf_from_spec(GREY), n_terms=grey.n_terms)
        other = best.eval_phi_exact(views)[..., 0] @ (
            best.eval_psi_exact(directions).T @ ((weights * directions[:, 2])[:, None] * y_light)
        )
        assert np.abs(other - expected).max() > 1e6 * tolerance


def test_what_is_left_is_orthogonal_to_the_harmonics(coloured, exitant, rule, rng):
    """The normal equations of the least squares over the hemisphere, colour by colour."""
    directions, weights = rule
    wi = directions[rng.integers(0, len(directions), 12)]
    rho = brdf_from_spec(COLOURED).eval_brdf(wi[:, None], directions[None])
    left = rho - summed(coloured, wi, directions)
    harmonics = weights[:, None] * exitant.evaluate(directions)
    scale = np.sqrt(np.einsum("ioc,o->ic", rho**2, weights)).max()
    along = np.einsum("ioc,ok->ick", left, harmonics)
    # rounding: both quadratures are exact for a lobe of degree 10
    assert np.abs(along).max() < 1e-10 * scale
    best = factorise(brdf_from_spec(COLOURED), n_terms=coloured.n_terms)
    other = np.einsum("ioc,ok->ick", rho - summed(best, wi, directions), harmonics)
    assert np.abs(other).max() > 1e-3 * scale


@pytest.mark.parametrize("name", ["grey", "coloured"])
def test_phi_is_orthonormal_and_psi_holds_the_singular_values(name, rule, request):
    found = request.getfixturevalue(name)
    directions, weights = rule
    squared = weights * directions[:, 2] ** 2
    phi = found.eval_phi_exact(directions)
    gram = np.einsum("okc,olc,o->kl", phi, phi, squared)
    np.testing.assert_allclose(gram, np.eye(found.n_terms), atol=1e-9)
    psi = found.eval_psi_exact(directions)
    gram = psi.T * squared @ psi
    values = found.singular_values
    assert (np.diff(values) <= 0.0).all()
    # 4e-3 of the largest: they are orthogonal on the grid of 28 rings
    np.testing.assert_allclose(gram, np.diag(values**2), rtol=0, atol=4e-3 * values[0] ** 2)


def test_the_energy_lost_is_that_of_a_dense_sum(coloured, rule):
    directions, weights = rule
    some = np.arange(0, len(directions), 5)
    rho = brdf_from_spec(COLOURED).eval_brdf(directions[some, None], directions[None])
    left = rho - summed(coloured, directions[some], directions)
    squared = weights * directions[:, 2] ** 2
    energy = [np.einsum("ioc,i,o->", part**2, squared[some], squared) for part in (left, rho)]
    assert coloured.energy_lost == pytest.approx(energy[0] / energy[1], rel=0.02)
    assert 0.001 < coloured.energy_lost < 0.1
    assert f"{coloured.energy_lost:.2%}" in coloured.note


def test_more_bands_leave_less(exitant, grey):
    brdf = brdf_from_spec(PhongSpec(kd=0.3, ks=0.7, exponent=10))
    lost = [
        factorise_harmonic(brdf, order, HemisphereBasis(order).kept).energy_lost
        for order in (3, 5, 8)
    ]
    assert lost[0] > 5 * lost[1] > 25 * lost[2]
    # of harmonics only those kept are used: 24 terms, of which pairs stand together
    assert grey.n_terms == exitant.n == 24
    assert len(grey.functions) == 14
    assert (grey.parity[np.flatnonzero(grey.parity) - 1] == 0).all()


def test_colours_share_psi(coloured):
    """One lobe and a coloured diffuse part: one term more than for grey."""
    assert coloured.n_channels == 3
    assert coloured.n_terms == 25


def test_tables_of_a_file_are_the_factorisation(coloured, rng):
    brdf = brdf_from_spec(COLOURED)
    read = factorisation_from_tables(coloured.tables(), brdf=brdf)
    assert isinstance(read, HarmonicFactorisation)
    assert read.view_order == ORDER
    wo = rng.normal(size=(50, 3))
    wo[:, 2] = np.abs(wo[:, 2])
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    np.testing.assert_array_equal(read.eval_psi_exact(wo), coloured.eval_psi_exact(wo))
    # phi is polynomial: it needs no BRDF
    bare = factorisation_from_tables(coloured.tables())
    np.testing.assert_array_equal(bare.eval_phi_exact(wo), coloured.eval_phi_exact(wo))
    # tables of 513 nodes, linear between them
    np.testing.assert_allclose(bare.eval_phi(wo), coloured.eval_phi_exact(wo), atol=2e-3)
    with pytest.raises(ValueError, match="needs the BRDF"):
        bare.eval_psi_exact(wo)


def test_colours_of_phi_follow_in_table_and_polynomial(coloured, rng):
    wo = np.array([[0.6, 0.0, 0.8], [0.0, 0.28, 0.96]])
    exact, tabled = coloured.eval_phi_exact(wo), coloured.eval_phi(wo)
    tint = np.array([0.5, 2.0, 1.0])
    np.testing.assert_allclose(coloured.tinted(tint).eval_phi_exact(wo), exact * tint)
    np.testing.assert_allclose(coloured.tinted(tint).eval_phi(wo), tabled * tint, rtol=1e-6)
    mean = exact.mean(axis=2, keepdims=True)
    np.testing.assert_allclose(coloured.greyed().eval_phi_exact(wo), mean)
    np.testing.assert_allclose(
        coloured.greyed().eval_phi(wo), tabled.mean(axis=2, keepdims=True), rtol=1e-4, atol=1e-6
    )


def test_a_constant_brdf_keeps_its_one_term_and_an_anisotropic_one_is_refused(exitant):
    constant = factorise_harmonic(brdf_from_spec(LambertSpec(albedo=0.4)), ORDER, exitant.kept)
    assert constant.is_constant_phi
    assert constant.n_terms == 1
    ward = brdf_from_spec(WardSpec(alpha_x=0.2, alpha_y=0.5))
    with pytest.raises(SettingsError, match="anisotropic") as refused:
        factorise_harmonic(ward, ORDER, exitant.kept)
    assert refused.value.pointer == "/settings/bake/factorisation"


def test_a_brdf_without_the_symmetry_it_claims_is_refused(exitant):
    ward = brdf_from_spec(WardSpec(alpha_x=0.2, alpha_y=0.5))

    class Quiet:
        n_channels = 1
        eval_brdf = staticmethod(ward.eval_brdf)

    with pytest.raises(BrdfError, match="isotropic and mirror-symmetric"):
        factorise_harmonic(Quiet(), ORDER, exitant.kept)


def test_the_loss_of_a_lobe_between_the_nodes_is_measured_finer(exitant):
    narrow = brdf_from_spec(CookTorranceSpec(kd=0.3, ks=0.05, m=0.05, f0=0.2))
    found = factorise_harmonic(narrow, ORDER, exitant.kept)
    exact = check_factorisation(narrow, found, n_theta=160, n_phi=640).relative_error
    assert found.energy_lost == pytest.approx(exact, rel=5e-3)
    coarse = check_factorisation(narrow, found).relative_error
    assert coarse != pytest.approx(exact, rel=5e-3)


@pytest.mark.parametrize("functions", [[0, 1], [0, 25]])
def test_half_a_pair_or_a_function_beyond_the_order_is_no_choice(functions):
    with pytest.raises(ValueError, match="both of every pair"):
        factorise_harmonic(brdf_from_spec(GREY), ORDER, np.array(functions))


def test_a_lobe_too_narrow_for_the_harmonics_is_refused(exitant):
    def lobe(m):
        spec = CookTorranceSpec(kd=0.0, ks=0.6, m=m, f0=0.2)
        return factorise_harmonic(brdf_from_spec(spec), ORDER, exitant.kept)

    assert 0.3 < lobe(0.2).energy_lost < 1.0
    with pytest.raises(BrdfError, match="more than none at all would") as refused:
        lobe(0.05)
    assert refused.value.pointer == "/settings/bake/view_order"
