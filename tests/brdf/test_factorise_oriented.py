"""Anisotropic BRDFs: four parities against the dense decomposition, the isotropic limit, off the grid."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from prtbake_storage.contract.brdf import (
    CookTorranceSpec,
    LafortuneLobe,
    LafortuneSpec,
    PhongSpec,
    WardSpec,
)
from prtbake_storage.errors import BrdfError, CorruptArtefact, SettingsError
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.factorise_oriented import factorise_oriented
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid
from prtbake_workers.brdf.oriented_checks import check_oriented_factorisation, measure_loss
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.spectrum import energy_lost_by_terms
from prtbake_workers.brdf.stored_factorisation import factorisation_from_tables
from prtbake_workers.brdf.view_texture import fit_view_texture
from prtbake_workers.percent import percent

TINY = HemisphereGrid(4, 24)
SMALL = HemisphereGrid(16, 64)
SPECS = {
    "ward": WardSpec(kd=0.1, ks=0.8, alpha_x=0.25, alpha_y=0.6),
    "coloured_ward": WardSpec(kd=(0.4, 0.2, 0.0), ks=(0.1, 0.5, 0.6), alpha_x=0.5, alpha_y=0.3),
    "lafortune": LafortuneSpec(
        kd=0.1,
        lobes=(
            LafortuneLobe(weight=0.8, cx=-0.6, cy=-0.95, cz=0.9, exponent=6.0),
            LafortuneLobe(weight=0.3, cx=0.9, cy=0.4, cz=1.0, exponent=4.0),
        ),
    ),
}
BRUSHED = WardSpec(kd=0.3, ks=0.7, alpha_x=0.1, alpha_y=0.4)


@pytest.fixture(scope="module", params=SPECS)
def oriented(request):
    return brdf_from_spec(SPECS[request.param])


@pytest.fixture(scope="module")
def tiny(oriented):
    return factorise_oriented(oriented, grid=TINY, n_terms=20, n_nodes=5)


@pytest.fixture(scope="module")
def brushed():
    """On the default grid, with as many terms as a job may take."""
    return factorise(brdf_from_spec(BRUSHED), n_terms=64)


@pytest.fixture(scope="module")
def brushed_loss(brushed):
    """What all its terms lose off the grid."""
    return measure_loss(brdf_from_spec(BRUSHED), brushed)[0]


def dense(brdf, grid):
    """The whole weighted matrix (light, view x channels) and the grid's directions."""
    z = np.repeat(grid.cosines, grid.n_phi)
    phi = np.tile(2 * np.pi * (np.arange(grid.n_phi) + 0.5) / grid.n_phi, grid.n_theta)
    s = np.sqrt(1 - z * z)
    w = np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1)
    weight = z * np.sqrt(2 * np.pi / (grid.n_theta * grid.n_phi))
    rho = brdf.eval_brdf(w[:, None], w[None])
    return w, weight, rho, (rho * weight[:, None, None] * weight[:, None]).reshape(len(w), -1)


def test_parities_give_the_dense_decomposition(oriented, tiny):
    found = tiny
    w, weight, rho, matrix = dense(oriented, TINY)
    left, values, right = np.linalg.svd(matrix, full_matrices=False)
    np.testing.assert_allclose(found.singular_values, values, atol=1e-12 * values[0])
    k = found.n_terms
    best = ((left[:, :k] * values[:k]) @ right[:k]).reshape(rho.shape)
    best /= weight[:, None, None] * weight[:, None]
    got = np.einsum("ik,okc->ioc", found.eval_psi_exact(w), found.eval_phi_exact(w))
    # division by the singular values of 20 terms and by cosines down to 1/8
    np.testing.assert_allclose(got, best, atol=1e-9 * rho.max())
    # twins: a part in a thousand more; x and y exchanged
    assert np.abs(got * 1.001 - best).max() > 1e-9 * rho.max()
    turned = w[:, [1, 0, 2]]
    wrong = np.einsum("ik,okc->ioc", found.eval_psi_exact(turned), found.eval_phi_exact(turned))
    assert np.abs(wrong - best).max() > 1e-3 * rho.max()


def test_terms_are_orthonormal_and_psi_holds_the_singular_values(oriented, tiny):
    found = tiny
    w, weight, _, _ = dense(oriented, TINY)
    phi, psi = found.eval_phi_exact(w), found.eval_psi_exact(w)
    gram = np.einsum("okc,olc,o->kl", phi, phi, weight**2)
    np.testing.assert_allclose(gram, np.eye(found.n_terms), atol=1e-9)
    energy = np.diag(found.singular_values[: found.n_terms] ** 2)
    np.testing.assert_allclose(
        np.einsum("ok,ol,o->kl", psi, psi, weight**2), energy, atol=1e-11 * energy[0, 0]
    )
    flat = np.einsum("okc,olc,o->kl", phi, phi, weight**2 / w[:, 2])
    assert np.abs(flat - np.eye(found.n_terms)).max() > 1e-2


@pytest.mark.parametrize(
    "spec", [CookTorranceSpec(m=0.4), PhongSpec(kd=0.3, ks=0.7, exponent=10.0)]
)
def test_an_isotropic_brdf_gives_what_the_isotropic_path_gives(spec, directions):
    brdf = brdf_from_spec(spec)
    found = factorise_oriented(brdf, grid=SMALL, n_terms=16)
    orders = factorise(brdf, n_terms=16, n_theta=16, n_phi=64)
    # the azimuths are shifted by half a step, which a circulant block does not see
    np.testing.assert_allclose(
        found.singular_values, orders.singular_values, atol=1e-13 * orders.singular_values[0]
    )
    # pairs are not split, although their members come from different parities
    assert (found.n_terms, found.note) == (orders.n_terms, orders.note)
    assert found.energy_lost == pytest.approx(orders.energy_lost, rel=1e-9)
    wi, wo = directions(60), directions(60, seed=2)

    def product(own, psi, phi):
        return np.einsum("nk,okc->noc", getattr(own, psi)(wi), getattr(own, phi)(wo))

    exact = product(orders, "eval_psi_exact", "eval_phi_exact")
    # both sums are the one best approximation, extended ring by ring and wave by wave
    np.testing.assert_allclose(
        product(found, "eval_psi_exact", "eval_phi_exact"), exact, atol=1e-9 * exact.max()
    )
    # tables: measured 1.1 % of the peak, at grazing angles, where the weight is small
    assert np.abs(product(found, "eval_psi", "eval_phi") - exact).max() < 2e-2 * exact.max()


def test_a_split_pair_would_turn_with_the_frame(directions):
    """Twin of the rule: whole pairs of an isotropic BRDF make a sum that no turn changes."""
    brdf = brdf_from_spec(PhongSpec(kd=0.3, ks=0.7, exponent=10.0))
    found = factorise_oriented(brdf, grid=SMALL, n_terms=15)
    wi, wo = directions(50), directions(50, seed=2)
    c, s = np.cos(0.77), np.sin(0.77)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])

    def off(own):
        psi, phi = own.eval_psi_exact, own.eval_phi_exact
        one = np.einsum("nk,nkc->nc", psi(wi), phi(wo))
        other = np.einsum("nk,nkc->nc", psi(wi @ turn), phi(wo @ turn))
        return np.abs(one - other).max()

    assert found.n_terms == 15
    assert off(found) < 1e-9
    fewer = slice(0, 14)
    split = replace(
        found,
        parities=found.parities[fewer],
        psi_grid=found.psi_grid[..., fewer],
        phi_grid=found.phi_grid[:, :, fewer],
        psi_rings=found.psi_rings[..., fewer],
        phi_rings=found.phi_rings[:, :, fewer],
    )
    assert off(split) > 1e-3


def test_ward_loses_what_its_spectrum_says(brushed, brushed_loss):
    """Reconstruction of (0.1, 0.4) off the grid, for several K."""
    brdf = brdf_from_spec(BRUSHED)
    errors = []
    for k in (8, 16, 32):
        keep = slice(0, k)
        cut = replace(
            brushed,
            parities=brushed.parities[keep],
            psi_grid=brushed.psi_grid[..., keep],
            phi_grid=brushed.phi_grid[:, :, keep],
            psi_rings=brushed.psi_rings[..., keep],
            phi_rings=brushed.phi_rings[:, :, keep],
        )
        errors.append(measure_loss(brdf, cut)[0])
    errors.append(brushed_loss)
    for k, lost in zip((8, 16, 32, 64), errors, strict=True):
        stated = energy_lost_by_terms(brushed.singular_values, k)
        # off the grid the extension fits as well or better: measured 0.99, 0.99, 0.97 and 0.79
        assert 0.7 * stated < lost < 1.02 * stated
    assert errors[0] > errors[1] > errors[2] > errors[3]
    assert brushed.energy_lost == energy_lost_by_terms(brushed.singular_values, 64)
    assert brushed.note is None
    # twin: the same sum for a surface brushed the other way
    swapped = brdf_from_spec(BRUSHED.model_copy(update={"alpha_x": 0.4, "alpha_y": 0.1}))
    assert measure_loss(swapped, brushed)[0] > 0.3


def test_tables_add_little(brushed, brushed_loss):
    report = check_oriented_factorisation(brdf_from_spec(BRUSHED), brushed)
    assert report.relative_error == pytest.approx(brushed_loss, rel=1e-3)
    # measured 2.6e-7: an amplitude of 5e-4
    assert report.tabulation < 5e-7
    # twin: half the rings give 7e-6
    psi, phi = brushed.psi_rings[::2], brushed.phi_rings[::2]
    coarse = replace(brushed, psi_rings=psi, phi_rings=phi)
    assert check_oriented_factorisation(brdf_from_spec(BRUSHED), coarse).tabulation > 5e-6


def test_the_fast_lookup_is_the_slow_one(brushed, directions):
    w = np.concatenate([directions(300), [[0, 0, 1.0], [1, 0, 0], [0, 0.6, -0.8], [0, 1, 1e-9]]])
    slow = brushed.eval_psi(w)
    fast = brushed.psi_lookup(*w.astype(np.float32).T.copy()).T
    # a step of the table is 1/256: rounding of the place in it to 2^-24 x 256
    np.testing.assert_allclose(fast, slow, atol=1e-4 * np.abs(slow).max())
    assert (fast[-2] == 0.0).all()
    assert (slow[-2] == 0.0).all()
    wrong = brushed.psi_lookup(*(w * [1, -1, 1]).astype(np.float32).T.copy()).T
    assert np.abs(wrong - slow).max() > 0.1 * np.abs(slow).max()


def test_signs_follow_the_parities(brushed, directions):
    w = directions(50)
    psi = brushed.eval_psi(w)
    odd_x, odd_y = brushed.parities.T
    # the same cell of the table, and a sign
    np.testing.assert_array_equal(brushed.eval_psi(w * [-1, 1, 1]), psi * (1 - 2 * odd_x))
    np.testing.assert_array_equal(brushed.eval_psi(w * [1, -1, 1]), psi * (1 - 2 * odd_y))
    assert {tuple(pair) for pair in brushed.parities.tolist()} == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_colours_share_psi_and_can_be_greyed(directions):
    brdf = brdf_from_spec(SPECS["coloured_ward"])
    found = factorise_oriented(brdf, grid=SMALL, energy_lost=0.01)
    wi, wo = directions(200), directions(200, seed=2)
    got = np.einsum("ik,okc->ioc", found.eval_psi(wi), found.eval_phi(wo))
    rho = brdf.eval_brdf(wi[:, None], wo[None])
    weight = (wi[:, None, 2] * wo[None, :, 2])[..., None]

    def lost(sums):
        return np.sum(((sums - rho) * weight) ** 2) / np.sum((rho * weight) ** 2)

    # 1 % and the sampling error of 40,000 pairs
    assert lost(got) < 0.015
    assert lost(got[..., ::-1]) > 0.05
    grey = found.greyed()
    assert grey.n_channels == 1
    np.testing.assert_allclose(
        grey.eval_phi(wo)[..., 0], found.eval_phi(wo).mean(axis=2), atol=1e-5
    )


def test_tables_come_back_through_hdf5(tmp_path, directions):
    brdf = brdf_from_spec(SPECS["ward"])
    found = factorise_oriented(brdf, grid=TINY, n_terms=5, n_nodes=17)
    with h5py.File(tmp_path / "tables.h5", "w") as file:
        for name, value in found.tables().items():
            if isinstance(value, np.ndarray):
                file[name] = value
            else:
                file.attrs[name] = value
    with h5py.File(tmp_path / "tables.h5") as file:
        tables = {name: data[()] for name, data in file.items()} | dict(file.attrs)
    back = factorisation_from_tables(tables, brdf=brdf)
    w = directions(100)
    np.testing.assert_array_equal(back.eval_psi(w), found.eval_psi(w))
    np.testing.assert_array_equal(back.eval_phi(w), found.eval_phi(w))
    np.testing.assert_array_equal(back.eval_psi_exact(w[:5]), found.eval_psi_exact(w[:5]))
    assert (back.note, back.requested_terms, back.energy_lost) == (found.note, 5, found.energy_lost)
    with pytest.raises(ValueError, match="needs the BRDF"):
        factorisation_from_tables(tables).eval_psi_exact(w)
    del tables["phi_rings"]
    with pytest.raises(CorruptArtefact, match="phi_rings"):
        factorisation_from_tables(tables)
    isotropic = factorise(brdf_from_spec(CookTorranceSpec()), n_terms=4, n_nodes=9)
    assert factorisation_from_tables(isotropic.tables()).orders.tolist() == [0, 1, 1]


def test_view_textures_hold_functions_of_both_angles(directions):
    found = factorise_oriented(brdf_from_spec(SPECS["ward"]), grid=SMALL, n_terms=9)
    fitted = fit_view_texture(found)
    assert fitted.values.shape[2:] == (9, 1)
    assert fitted.error < 3e-3


def test_a_lobe_too_narrow_for_the_terms_is_said_or_refused():
    coarse = {"n_theta": 10, "n_phi": 40}
    sharp = brdf_from_spec(WardSpec(ks=1.0, alpha_x=0.05, alpha_y=0.2))
    found = factorise(sharp, n_terms=16, **coarse)
    assert "10 x 40 does not resolve the lobe" in found.note
    assert f"{percent(found.energy_lost)} in truth" in found.note
    assert found.energy_lost > energy_lost_by_terms(found.singular_values, 16) + 0.02
    needle = brdf_from_spec(WardSpec(ks=1.0, alpha_x=0.02, alpha_y=0.03))
    with pytest.raises(BrdfError, match="too narrow") as caught:
        factorise(needle, n_terms=64, **coarse)
    assert caught.value.pointer == "/brdf"


def test_what_has_no_lobe_is_diffuse_whatever_its_slopes():
    found = factorise(brdf_from_spec(WardSpec(kd=0.5, ks=0.0, alpha_x=0.1, alpha_y=0.3)), n_terms=3)
    assert (found.is_constant_phi, found.n_terms) == (True, 1)
    # twelve digits: a sum over four images, a quarter of it
    np.testing.assert_allclose(found.phi_radial[0, 0, 0], 0.5, rtol=1e-12)


def test_energy_chooses_the_fewest_terms():
    brdf = brdf_from_spec(SPECS["ward"])
    found = factorise_oriented(brdf, grid=SMALL, energy_lost=0.02, n_nodes=5)
    assert found.energy_lost <= 0.02
    fewer = factorise_oriented(brdf, grid=SMALL, n_terms=found.n_terms - 1, n_nodes=5)
    assert fewer.energy_lost > 0.02
    with pytest.raises(SettingsError, match=r"2 terms \(of at most 2\)"):
        factorise_oriented(brdf, grid=SMALL, energy_lost=0.02, max_terms=2, n_nodes=5)


class Bent:
    """Mirror-symmetric about neither axis: the lobe leans along x."""

    n_channels = 1
    is_isotropic = False

    def eval_brdf(self, wi, wo):
        return np.exp(wi[..., :1] + wo[..., :1])


class OneWay(Bent):
    """Not reciprocal."""

    def eval_brdf(self, wi, wo):
        return 1.0 + wi[..., :1] ** 2


class Broken(Bent):
    def eval_brdf(self, wi, wo):
        return np.where(np.abs(wi[..., :1]) > 0.98, np.nan, 1.0) + 0.0 * wo[..., :1]


@pytest.mark.parametrize(("brdf", "what"), [(Bent(), "mirror"), (OneWay(), "reciprocal")])
def test_missing_symmetries_are_told(brdf, what):
    with pytest.raises(BrdfError, match=what):
        factorise(brdf, n_terms=3)


def test_a_value_that_is_none_is_named():
    with pytest.raises(BrdfError, match=r"nan.* at wi = "):
        factorise_oriented(Broken(), grid=TINY, n_terms=1)


def test_azimuths_must_mirror_each_other():
    with pytest.raises(SettingsError, match="multiple of 4"):
        factorise_oriented(brdf_from_spec(BRUSHED), grid=HemisphereGrid(4, 6), n_terms=1)


def test_equal_inputs_give_equal_bytes():
    first, second = (
        factorise_oriented(brdf_from_spec(SPECS["ward"]), grid=TINY, n_terms=9, n_nodes=9).tables()
        for _ in range(2)
    )
    for name, value in first.items():
        assert np.asarray(value).tobytes() == np.asarray(second[name]).tobytes()
