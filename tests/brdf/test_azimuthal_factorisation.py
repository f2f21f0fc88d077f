from dataclasses import replace

import h5py
import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec, LambertSpec, PhongSpec
from prtbake_storage.errors import CorruptArtefact
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.hemisphere_grid import norm_of_order
from prtbake_workers.brdf.registry import brdf_from_spec

GLOSS = brdf_from_spec(CookTorranceSpec())


@pytest.fixture(scope="module")
def gloss():
    return factorise(GLOSS, n_terms=16)


def grid_directions(found):
    z = np.repeat(found.cosines, 5)
    phi = np.tile([0.0, 0.4, 1.9, 3.3, 5.1], len(found.cosines))
    s = np.sqrt(1 - z * z)
    return np.stack([s * np.cos(phi), s * np.sin(phi), z], axis=-1), phi


def test_the_extension_meets_the_grid(gloss):
    w, phi = grid_directions(gloss)
    wave = np.where(
        gloss.parity == 0, np.cos(np.outer(phi, gloss.orders)), np.sin(np.outer(phi, gloss.orders))
    )
    psi = np.repeat(gloss.psi_radial, 5, axis=0) * wave
    view = np.repeat(gloss.phi_radial, 5, axis=0) * wave[..., None]
    scale = np.abs(psi).max()
    # sums of 28 terms in another order than the decomposition's
    np.testing.assert_allclose(gloss.eval_psi_exact(w), psi, atol=1e-12 * scale)
    np.testing.assert_allclose(gloss.eval_phi_exact(w), view, atol=1e-9)
    # twin: a direction one degree off the ring is another value
    assert np.abs(gloss.eval_psi_exact(w * [1.02, 1.02, 0.98]) - psi).max() > 1e-3 * scale


@pytest.mark.parametrize(
    ("spec", "psi_bound", "phi_bound"),
    [
        # measured: 1.9e-5 / 1.4e-4, 5e-6 / 1.1e-5, 3.1e-4 / 5.3e-4
        (CookTorranceSpec(), 5e-5, 4e-4),
        (PhongSpec(kd=0.3, ks=0.7, exponent=10.0), 1.5e-5, 3e-5),
        (CookTorranceSpec(m=0.1), 1e-3, 1.5e-3),
    ],
)
def test_tables_stand_for_the_exact_extension(spec, psi_bound, phi_bound, directions):
    """Relative error in the norm with the cosine: its square, 1e-7 at most, is a budget line."""
    found = factorise(brdf_from_spec(spec), n_terms=16)
    w = directions(500)

    def error(got, wanted):
        cosine = w[:, 2].reshape(-1, *[1] * (got.ndim - 1))
        return np.linalg.norm((got - wanted) * cosine) / np.linalg.norm(wanted * cosine)

    psi, phi = found.eval_psi_exact(w), found.eval_phi_exact(w)
    assert error(found.eval_psi(w), psi) < psi_bound
    assert error(found.eval_phi(w), phi) < phi_bound
    fast = found.psi_lookup(*w.astype(np.float32).T.copy()).T
    assert error(fast, psi) < psi_bound + 1e-6
    # twin: a table of a sixteenth of the nodes is not good enough
    coarse = factorise(brdf_from_spec(spec), n_terms=16, n_nodes=33)
    assert error(coarse.eval_psi(w), psi) > psi_bound


def test_the_sum_of_products_is_the_brdf(directions):
    """With the terms for 0.1 % of the energy the weighted error off the grid is that, too."""
    found = factorise(GLOSS, energy_lost=0.001)
    wi, wo = directions(250), directions(250, seed=2)
    weight = wi[:, None, 2] * wo[None, :, 2]
    rho = GLOSS.eval_brdf(wi[:, None], wo[None])[..., 0]
    got = found.eval_psi(wi) @ found.eval_phi(wo)[..., 0].T
    lost = np.sum(((got - rho) * weight) ** 2) / np.sum((rho * weight) ** 2)
    assert lost < 0.0015  # 0.1 % within the sampling error of 62,500 pairs
    swapped = found.eval_psi(wi * [1, -1, 1]) @ found.eval_phi(wo)[..., 0].T
    assert np.sum(((swapped - rho) * weight) ** 2) / np.sum((rho * weight) ** 2) > 0.01


@pytest.mark.parametrize(("grid", "bound"), [((28, 112), 2e-3), ((48, 112), 7e-4)])
def test_phi_is_orthonormal_on_the_hemisphere_too(grid, bound):
    """Off the grid the midpoint rule's error is left, 1e-3 and falling with the step's square."""
    found = factorise(GLOSS, n_terms=16, n_theta=grid[0], n_phi=grid[1], n_nodes=3)
    node, weight = np.polynomial.legendre.leggauss(120)
    z = (node + 1) / 2
    radial = found.radial_exact(z, light_side=False)[..., 0]
    orders = found.orders[found.parity == 0]
    gram = np.einsum("zk,zl,z->kl", radial, radial, weight / 2 * z * z) * norm_of_order(orders)
    same = orders[:, None] == orders
    assert np.abs(np.where(same, gram - np.eye(len(orders)), 0)).max() < bound
    flat = np.einsum("zk,zl,z->kl", radial, radial, weight / 2 * z) * norm_of_order(orders)
    assert np.abs(np.where(same, flat - np.eye(len(orders)), 0)).max() > 0.1


def test_turning_the_frame_changes_no_product(gloss, directions):
    wi, wo = directions(50), directions(50, seed=2)
    c, s = np.cos(0.77), np.sin(0.77)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])

    def product(found, a, b):
        return np.einsum("nk,nkc->nc", found.eval_psi(a), found.eval_phi(b))

    before = product(gloss, wi, wo)
    # orders up to 7 multiply the rounding of the turned coordinates
    np.testing.assert_allclose(product(gloss, wi @ turn.T, wo @ turn.T), before, atol=1e-12)
    # twin: with the last pair split the frame shows
    keep = slice(0, gloss.n_terms - 1)
    split = replace(
        gloss,
        orders=gloss.orders[keep],
        parity=gloss.parity[keep],
        psi_radial=gloss.psi_radial[:, keep],
        phi_radial=gloss.phi_radial[:, keep],
    )
    psi, phi = split.eval_psi_exact, split.eval_phi_exact
    one = np.einsum("nk,nkc->nc", psi(wi), phi(wo))
    other = np.einsum("nk,nkc->nc", psi(wi @ turn.T), phi(wo @ turn.T))
    assert np.abs(one - other).max() > 1e-4


def test_colours_share_psi(directions):
    brdf = brdf_from_spec(CookTorranceSpec(kd=(0.5, 0.3, 0.1), m=0.4, f0=(1.0, 0.77, 0.34)))
    found = factorise(brdf, energy_lost=0.01)
    wi, wo = directions(200), directions(200, seed=2)
    assert found.eval_psi(wi).shape == (200, found.n_terms)
    assert found.eval_phi(wo).shape == (200, found.n_terms, 3)
    got = np.einsum("ik,okc->ioc", found.eval_psi(wi), found.eval_phi(wo))
    rho = brdf.eval_brdf(wi[:, None], wo[None])
    weight = (wi[:, None, 2] * wo[None, :, 2])[..., None]
    assert np.sum(((got - rho) * weight) ** 2) / np.sum((rho * weight) ** 2) < 0.015
    assert np.sum(((got[..., ::-1] - rho) * weight) ** 2) / np.sum((rho * weight) ** 2) > 0.05


def test_a_grey_brdf_in_three_channels_has_the_same_spectrum():
    grey = factorise(GLOSS, n_terms=16, n_nodes=3)
    spec = CookTorranceSpec(kd=(0.3, 0.3, 0.3))
    three = factorise(brdf_from_spec(spec), n_terms=16, n_nodes=3)
    np.testing.assert_allclose(
        three.singular_values[:50], np.sqrt(3) * grey.singular_values[:50], rtol=1e-9
    )
    np.testing.assert_array_equal(three.orders, grey.orders)


@pytest.mark.parametrize("spec", [CookTorranceSpec(), LambertSpec(albedo=(0.1, 0.2, 0.3))])
def test_tables_come_back_through_hdf5(tmp_path, spec, directions):
    brdf = brdf_from_spec(spec)
    found = factorise(brdf, n_terms=15, n_nodes=65)
    with h5py.File(tmp_path / "tables.h5", "w") as file:
        for name, value in found.tables().items():
            if isinstance(value, np.ndarray):
                file[name] = value
            else:
                file.attrs[name] = value
    with h5py.File(tmp_path / "tables.h5") as file:
        tables = {name: data[()] for name, data in file.items()} | dict(file.attrs)
    back = AzimuthalFactorisation.from_tables(tables)
    w = directions(100)
    np.testing.assert_array_equal(back.eval_psi(w), found.eval_psi(w))
    np.testing.assert_array_equal(back.eval_phi(w), found.eval_phi(w))
    assert (back.note, back.requested_terms) == (found.note, 15)
    assert (back.energy_lost, back.is_constant_phi) == (found.energy_lost, found.is_constant_phi)
    again = AzimuthalFactorisation.from_tables(tables, brdf=brdf)
    np.testing.assert_array_equal(again.eval_psi_exact(w), found.eval_psi_exact(w))


def test_missing_tables_are_named(gloss):
    tables = gloss.tables()
    del tables["phi_table"], tables["n_phi"]
    with pytest.raises(CorruptArtefact, match="phi_table, n_phi"):
        AzimuthalFactorisation.from_tables(tables)
    with pytest.raises(ValueError, match="needs the BRDF"):
        AzimuthalFactorisation.from_tables(gloss.tables()).eval_psi_exact(np.array([[0, 0, 1.0]]))
