import numpy as np

from prtbake_storage.contract.brdf import GgxSpec
from prtbake_workers.brdf.base import above_horizon
from prtbake_workers.brdf.checks import check_reciprocity
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.symmetrised import Symmetrised


class Lopsided:
    """Isotropic, but neither reciprocal nor its own mirror image."""

    n_channels = 1

    def eval_brdf(self, wi, wo):
        twist = wi[..., 0] * wo[..., 1] - wi[..., 1] * wo[..., 0]
        value = 1.0 + wi[..., 2] + 0.5 * twist
        return np.where(above_horizon(wi, wo), value, 0.0)[..., None]


def test_both_symmetries_hold_to_the_last_bit(directions):
    wi, wo = directions(200), directions(200, seed=2)
    mean = Symmetrised(Lopsided())
    flip = np.array([1.0, -1.0, 1.0])
    value = mean.eval_brdf(wi, wo)
    np.testing.assert_array_equal(mean.eval_brdf(wo, wi), value)
    np.testing.assert_array_equal(mean.eval_brdf(wi * flip, wo * flip), value)
    # the twist cancels; each order weighs as the cosine of its view
    cos_i, cos_o = wi[:, 2], wo[:, 2]
    np.testing.assert_allclose(value[:, 0], 1.0 + 2 * cos_i * cos_o / (cos_i + cos_o), rtol=1e-13)
    assert not check_reciprocity(Lopsided()).reciprocal


def test_what_is_symmetric_stays_as_it_is(directions):
    ggx = brdf_from_spec(GgxSpec(f0=(0.9, 0.5, 0.2)))
    wi, wo = directions(100), directions(100, seed=2)
    np.testing.assert_allclose(
        Symmetrised(ggx).eval_brdf(wi, wo), ggx.eval_brdf(wi, wo), rtol=1e-13
    )
    assert Symmetrised(ggx).n_channels == 3


def test_leading_axes_broadcast(directions):
    wi, wo = directions(5), directions(7, seed=2)
    assert Symmetrised(Lopsided()).eval_brdf(wi[:, None], wo[None]).shape == (5, 7, 1)
