import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec
from prtbake_storage.errors import BrdfError, SettingsError
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid, azimuthal_blocks, norm_of_order
from prtbake_workers.brdf.registry import brdf_from_spec


def at(cos, phi):
    s = np.sqrt(1 - cos * cos)
    return np.stack([s * np.cos(phi), s * np.sin(phi), cos + 0 * phi], axis=-1)


def test_blocks_are_the_integrals_over_the_whole_circle():
    brdf = brdf_from_spec(CookTorranceSpec())
    cosines, n_phi = np.array([0.2, 0.7, 0.95]), 24
    blocks = azimuthal_blocks(brdf, cosines, cosines, n_phi)
    phi = 2 * np.pi * np.arange(n_phi) / n_phi
    value = brdf.eval_brdf(at(cosines[:, None, None], np.zeros(1)), at(cosines[:, None], phi))
    for m in range(n_phi // 2 + 1):
        plain = (value[..., 0] * np.cos(m * phi)).sum(axis=-1) * 2 * np.pi / n_phi
        # the transform sums the same numbers in another order
        np.testing.assert_allclose(blocks[m, :, :, 0], plain, rtol=1e-12, atol=1e-14)
        assert np.abs((value[..., 0] * np.sin(m * phi)).sum(axis=-1)).max() < 1e-12
    # twin: a step of the circle short
    assert (
        np.abs(value[..., :-1, 0].sum(axis=-1) * 2 * np.pi / n_phi - blocks[0, :, :, 0]).max()
        > 1e-3
    )


def test_blocks_give_the_brdf_back():
    brdf = brdf_from_spec(CookTorranceSpec())
    cosines, n_phi, k = np.array([0.3, 0.8]), 16, 3
    blocks = azimuthal_blocks(brdf, cosines, cosines, n_phi)[..., 0]
    orders = np.arange(len(blocks), dtype=np.int32)
    norm = norm_of_order(orders)
    norm[-1] *= 2  # the grid sees cos^2 = 1 of its last order
    delta = 2 * np.pi * k / n_phi
    got = np.einsum("mio,m->io", blocks, np.cos(orders * delta) / norm)
    value = brdf.eval_brdf(at(cosines[:, None], np.zeros(1)), at(cosines, np.full(1, delta)))
    np.testing.assert_allclose(got, value[..., 0], rtol=1e-12)


def test_small_passes_give_the_same(monkeypatch):
    brdf = brdf_from_spec(CookTorranceSpec())
    cosines = HemisphereGrid(7, 12).cosines
    whole = azimuthal_blocks(brdf, cosines, cosines, 12)
    monkeypatch.setattr("prtbake_workers.brdf.hemisphere_grid.VALUES_A_PASS", 1)
    np.testing.assert_array_equal(azimuthal_blocks(brdf, cosines, cosines, 12), whole)
    few = azimuthal_blocks(brdf, cosines, cosines, 12, n_orders=3)
    np.testing.assert_array_equal(few, whole[:3])


@pytest.mark.parametrize(("n_theta", "n_phi"), [(1, 12), (4, 13), (4, 2)])
def test_grids_that_cannot_serve_are_refused(n_theta, n_phi):
    with pytest.raises(SettingsError, match=r"n_theta|n_phi"):
        HemisphereGrid(n_theta, n_phi)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -1.0])
def test_a_bad_value_is_refused_with_its_place(bad):
    class Broken:
        n_channels = 1

        def eval_brdf(self, wi, wo):
            value = np.ones((*np.broadcast_shapes(wi.shape, wo.shape)[:-1], 1))
            value[1, 2, 3] = bad
            return value

    cosines = np.array([0.25, 0.5, 0.75])
    with pytest.raises(BrdfError, match=r"cos_i = 0\.5, cos_o = 0\.75, azimuth step 3 of 4"):
        azimuthal_blocks(Broken(), cosines, cosines, 8)
