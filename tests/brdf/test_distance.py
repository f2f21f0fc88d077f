import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec, LambertSpec, PhongSpec, WardSpec
from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.distance import brdf_distance
from prtbake_workers.brdf.registry import brdf_from_spec

GREY = brdf_from_spec(LambertSpec(albedo=0.5))


def test_a_brdf_is_at_no_distance_from_itself():
    brdf = brdf_from_spec(CookTorranceSpec())
    assert brdf_distance(brdf, brdf).to_dict() == {"relative_l2": 0.0, "median_ratio": 1.0}


def test_a_scaled_brdf_is_as_far_as_its_scale():
    found = brdf_distance(brdf_from_spec(LambertSpec(albedo=0.6)), GREY)
    assert found.relative_l2 == pytest.approx(0.2, rel=1e-12)
    assert found.median_ratio == pytest.approx(1.2, rel=1e-12)


def test_the_norm_is_weighted_with_both_cosines():
    """cos_i against 1 with the weight cos_i cos_o: integrals of (x - 1)^2 x^2 and of x^2."""

    class Tilted:
        n_channels = 1

        def eval_brdf(self, wi, wo):
            return np.broadcast_arrays(wi, wo)[0][..., 2:] / (2 * np.pi)

    found = brdf_distance(Tilted(), GREY, n_theta=200, n_phi=8)
    # midpoint rule of 200 rings
    assert found.relative_l2 == pytest.approx(np.sqrt(3 * (1 / 5 - 2 / 4 + 1 / 3)), rel=1e-4)
    # twin: without the weight it would be the root of 1 / 3
    assert abs(found.relative_l2 - 1 / np.sqrt(3)) > 0.1


def test_grey_and_coloured_compare():
    coloured = brdf_from_spec(LambertSpec(albedo=(0.5, 0.5, 1.0)))
    assert brdf_distance(coloured, GREY).relative_l2 == pytest.approx(1 / np.sqrt(3), rel=1e-12)


def test_highlights_decide_one_figure_and_not_the_other():
    sharp, sharper = (brdf_from_spec(PhongSpec(kd=0.5, ks=0.5, exponent=n)) for n in (50, 100))
    found = brdf_distance(sharper, sharp)
    assert found.relative_l2 > 0.3
    assert found.median_ratio == pytest.approx(1.0, abs=0.01)


def test_anisotropic_brdfs_are_seen_from_all_sides():
    along, across, round_ = (
        brdf_from_spec(WardSpec(kd=0.0, ks=0.5, alpha_x=x, alpha_y=y))
        for x, y in ((0.3, 0.5), (0.5, 0.3), (0.4, 0.4))
    )
    assert brdf_distance(along, along).relative_l2 == 0.0
    # a quarter turn of one is the other: as far from what a turn leaves as it is
    one, other = (brdf_distance(each, round_).relative_l2 for each in (along, across))
    assert one == pytest.approx(other, rel=1e-9)
    assert 0.1 < one < brdf_distance(along, across).relative_l2
    # twin: seen from one side only they are not as far from each other as the other way round
    sides = [
        brdf_distance(*pair, n_azimuths=1).relative_l2
        for pair in ((along, across), (across, along))
    ]
    assert sides[0] != pytest.approx(sides[1], rel=1e-3)
    assert brdf_distance(along, across).relative_l2 == pytest.approx(
        brdf_distance(across, along).relative_l2, rel=1e-9
    )


def test_what_cannot_be_compared_is_refused():
    black = brdf_from_spec(LambertSpec(albedo=0.0))
    with pytest.raises(BrdfError, match="black"):
        brdf_distance(GREY, black)
    assert brdf_distance(black, black).relative_l2 == 0.0
