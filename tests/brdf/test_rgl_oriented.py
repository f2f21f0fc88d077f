"""Anisotropic tensor files: Ward written by the format's description, and read back."""

import numpy as np
import pytest

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf import oriented_checks, rgl_oriented
from prtbake_workers.brdf.base import is_isotropic
from prtbake_workers.brdf.checks import check_reciprocity
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.oriented_factorisation import OrientedFactorisation
from prtbake_workers.brdf.rgl_fields import rgl_from_tensors
from prtbake_workers.brdf.rgl_oriented import OrientedRglTensor
from prtbake_workers.brdf.symmetrised import MIRROR_IMAGES, SymmetrisedOriented
from prtbake_workers.brdf.tensor_file import read_tensor_file
from prtbake_workers.brdf.ward import Ward
from support.tensor_file import oriented_fields, tensor_bytes

SLOPES = (0.3, 0.6)
WARD = Ward(np.full(3, 0.2), np.array([0.6, 0.5, 0.4]), *SLOPES)
INSIDE = 0.26
"""Cosine of 75 degrees: beyond the last angle of light the table is held."""


@pytest.fixture(scope="module")
def fields():
    return oriented_fields(WARD, SLOPES, n_lights=8)


@pytest.fixture(scope="module")
def tensor(fields):
    return rgl_from_tensors(read_tensor_file(tensor_bytes(fields)))[0]


def error(brdf, directions, inside=0.0, model=WARD):
    """Relative L2, cosine-weighted, over pairs with both cosines above ``inside``."""
    wi, wo = directions(20_000), directions(20_000, seed=2)
    kept = (wi[:, 2] > inside) & (wo[:, 2] > inside)
    wi, wo = wi[kept], wo[kept]
    weight = (wi[:, 2] * wo[:, 2])[:, None]
    exact = model.eval_brdf(wi, wo)
    return np.linalg.norm((brdf.eval_brdf(wi, wo) - exact) * weight) / np.linalg.norm(
        exact * weight
    )


def test_a_tabulated_ward_is_ward(tensor, directions):
    """8 angles by 5 azimuths of light, 20 x 20 values: bilinear in all four."""
    assert isinstance(tensor, OrientedRglTensor)
    assert not is_isotropic(tensor)
    # 1.8 % and 5.1 % were measured; that they are the tables' is shown below
    assert error(tensor, directions, INSIDE) < 0.025
    assert error(tensor, directions) < 0.06


def test_the_error_falls_with_finer_tables(directions):
    coarse, fine = (
        rgl_from_tensors(oriented_fields(WARD, SLOPES, **sizes))[0]
        for sizes in (
            {"n_azimuths": 3, "n_lights": 4, "n": 10, "n_normals": 24, "n_rows": 25},
            {"n_azimuths": 9, "n_lights": 12, "n": 32, "n_normals": 96, "n_rows": 97},
        )
    )
    assert error(fine, directions, INSIDE) < 0.2 * error(coarse, directions, INSIDE)
    assert error(fine, directions, INSIDE) < 0.01


@pytest.mark.parametrize("broken", ["sigma", "ndf", "vndf", "azimuths", "quarter turn"])
def test_every_field_has_its_part(fields, directions, broken):
    """Negative twins: a wrong table in any place is a wrong BRDF."""
    wrong = dict(fields)
    if broken == "azimuths":
        wrong["rgb"] = fields["rgb"][::-1]
    elif broken == "quarter turn":
        wrong["ndf"] = np.roll(fields["ndf"][:-1], 12, axis=0)[[*range(48), 0]]
    else:
        wrong[broken] = np.ones_like(fields[broken])
    assert error(rgl_from_tensors(wrong)[0], directions, INSIDE) > 0.04


def test_a_quarter_turn_of_the_surface_is_another_brdf(tensor, directions):
    turned = Ward(WARD.kd, WARD.ks, *SLOPES[::-1])
    assert error(tensor, directions, INSIDE, model=turned) > 0.2


@pytest.mark.parametrize(("reduction", "n_azimuths"), [(2, 9), (1, 17)])
def test_files_of_more_azimuths_hold_the_same_surface(directions, reduction, n_azimuths):
    sizes = {"reduction": reduction, "n_azimuths": n_azimuths, "n_lights": 8}
    whole, report = rgl_from_tensors(oriented_fields(WARD, SLOPES, **sizes))
    assert (report["reduction"], report["n_azimuths"]) == (reduction, n_azimuths)
    assert (whole.reduction, whole.mirror_images) == (reduction, 4 // reduction)
    assert error(whole, directions, INSIDE) < 0.03
    # they hold what a file of a quarter cannot: the mirror image of a skewed surface is another
    skewed = oriented_fields(Skewed(), SLOPES, **sizes)
    assert error(rgl_from_tensors(skewed)[0], directions, INSIDE, model=Skewed()) < 0.05
    assert error(rgl_from_tensors(skewed)[0], directions, INSIDE) > 0.15


class Skewed:
    """Ward with its grain 20 degrees askew."""

    n_channels = 3
    is_isotropic = False

    def eval_brdf(self, wi, wo):
        c, s = np.cos(np.deg2rad(20.0)), np.sin(np.deg2rad(20.0))
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return WARD.eval_brdf(wi @ turn, wo @ turn)


@pytest.mark.parametrize(
    ("reduction", "images"), [(4, MIRROR_IMAGES), (2, MIRROR_IMAGES[::3]), (1, MIRROR_IMAGES[:1])]
)
def test_what_was_not_measured_follows_by_symmetry(directions, reduction, images):
    brdf = rgl_from_tensors(
        oriented_fields(WARD, SLOPES, reduction=reduction, n_azimuths=20 // reduction + 1,
                        n_lights=4, n=10, n_normals=24, n_rows=24)
    )[0]  # fmt: skip
    wi, wo = directions(200), directions(200, seed=2)
    # in the mirrors and on the axis, too: there the view decides
    wi[:4] = [[0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8], [-0.6, -0.0, 0.8]]
    value = brdf.eval_brdf(wi, wo)
    for image in MIRROR_IMAGES:
        same = np.array_equal(brdf.eval_brdf(wi * image, wo * image), value)
        assert same == any((image == one).all() for one in images)


def test_made_symmetric_it_serves_transfer(tensor, directions, monkeypatch):
    # views that resolve slopes of 0.3; what a job takes resolves any
    monkeypatch.setattr(oriented_checks, "VIEW_RINGS", 24)
    monkeypatch.setattr(oriented_checks, "VIEW_AZIMUTHS", 96)
    brdf = SymmetrisedOriented(tensor, tensor.mirror_images)
    assert check_reciprocity(brdf).max_relative == 0.0
    assert not check_reciprocity(tensor).reciprocal
    assert error(brdf, directions, INSIDE) < 0.025
    grid = {"n_terms": 12, "n_theta": 10, "n_phi": 40, "n_nodes": 17}
    found, model = factorise(brdf, **grid), factorise(WARD, **grid)
    assert isinstance(found, OrientedFactorisation)
    np.testing.assert_allclose(found.singular_values[:6], model.singular_values[:6], rtol=0.02)
    # the bilinear table's kinks are energy that no term holds: 0.25 % of the norm beside 1.7 %
    assert found.energy_lost == pytest.approx(model.energy_lost, rel=0.2)
    # negative twin: that of a surface turned by a quarter pairs other parities
    turned = factorise(Ward(WARD.kd, WARD.ks, *SLOPES[::-1]), **grid)
    assert not np.array_equal(turned.parities[:6], found.parities[:6])
    np.testing.assert_array_equal(model.parities[:6], found.parities[:6])


def test_without_its_symmetry_the_factorisation_refuses_it():
    skewed = rgl_from_tensors(
        oriented_fields(Skewed(), SLOPES, reduction=2, n_azimuths=9, n_lights=4, n=10)
    )[0]
    with pytest.raises(BrdfError, match="not mirror-symmetric"):
        factorise(skewed, n_terms=4, n_theta=6, n_phi=24)


def test_the_mean_of_all_images_is_that_of_the_two_that_differ(directions):
    half = rgl_from_tensors(
        oriented_fields(Skewed(), SLOPES, reduction=2, n_azimuths=9, n_lights=4, n=10)
    )[0]
    wi, wo = directions(100), directions(100, seed=2)
    two, four = (SymmetrisedOriented(half, images).eval_brdf(wi, wo) for images in (2, 4))
    np.testing.assert_allclose(two, four, rtol=1e-12)
    for image in MIRROR_IMAGES:
        np.testing.assert_array_equal(
            SymmetrisedOriented(half, 2).eval_brdf(wi * image, wo * image), two
        )
    assert np.abs(two / SymmetrisedOriented(half, 1).eval_brdf(wi, wo) - 1.0).max() > 0.1


def test_grazing_light_and_view_are_finite(tensor):
    cos = np.array([1e-300, 1e-30, 1e-12, 1e-6, 1e-3, 0.3, 1.0])
    sin = np.sqrt(1 - cos * cos)
    for phi_i in (0.0, 1.0, np.pi):
        wi = np.stack([sin * np.cos(phi_i), sin * np.sin(phi_i), cos], axis=-1)[:, None]
        for phi in (0.0, 1e-9, 1.0, np.pi):
            wo = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=-1)[None]
            value = tensor.eval_brdf(wi, wo)
            assert np.isfinite(value).all()
            assert (value >= 0.0).all()
    assert not tensor.eval_brdf(wi[-1], np.array([[0.6, 0.0, -0.8]])).any()


@pytest.mark.parametrize(
    ("phi_i", "reduction"),
    [
        (np.linspace(-np.pi, -np.pi / 2, 4), 4),
        (np.linspace(-np.pi, 0, 5), 2),
        (np.linspace(-np.pi, np.pi, 9), 1),
        # whole turns without their end; the first has half a turn and one step
        (np.array([-np.pi, -np.pi / 3, np.pi / 3]), 1),
        (np.linspace(-np.pi, np.pi, 9)[:-1], 1),
        # at the middles of equal parts
        (np.linspace(-np.pi, np.pi, 17)[1::2], 1),
        (np.linspace(-np.pi, 0, 17)[1::2], 2),
        (np.linspace(-np.pi, -np.pi / 2, 9)[1::2], 4),
    ],
    ids=range(8),
)
def test_azimuths_tell_the_part_of_a_turn_that_they_span(phi_i, reduction):
    # as files hold them
    assert rgl_oriented._reduction(phi_i.astype("f4").astype(np.float64)) == reduction


def test_a_whole_turn_without_its_end_goes_around(directions):
    """The azimuth that is left out was measured at the other end."""
    fields = oriented_fields(Skewed(), SLOPES, reduction=1, n_azimuths=9, n_lights=4, n=10)
    whole = rgl_from_tensors(fields)[0]
    cut = {name: fields[name][:-1] for name in ("phi_i", "vndf", "rgb")}
    open_ended = rgl_from_tensors(fields | cut)[0]
    assert open_ended.reduction == 1
    wi, wo = directions(2000), directions(2000, seed=2)
    # rounding of float32 azimuths and tables, in sums over a hundred nodes
    expected = whole.eval_brdf(wi, wo)
    np.testing.assert_allclose(open_ended.eval_brdf(wi, wo), expected, rtol=1e-4, atol=1e-5)
    # negative twin: another azimuth that is left out changes what lies beside it
    kept = [0, 1, 2, 3, 5, 6, 7, 8]
    coarser = rgl_from_tensors(
        fields | {name: fields[name][kept] for name in ("phi_i", "vndf", "rgb")}
    )[0]
    off = np.abs(coarser.eval_brdf(wi, wo) - expected).max(axis=1) > 1e-3
    assert 0.1 < off.mean() < 0.4


def test_a_density_of_nothing_is_named_by_its_light(fields):
    nothing = fields["vndf"].copy()
    nothing[1, 2] = 0.0
    angle = np.rad2deg(fields["theta_i"][2])
    says = f"'vndf' is zero everywhere for light at phi_i -157.5 and theta_i {angle:.4g} degrees"
    with pytest.raises(BrdfError, match=says):
        rgl_from_tensors(fields | {"vndf": nothing})


@pytest.mark.parametrize(
    ("phi_i", "says"),
    [
        (np.linspace(0, np.pi, 5), "'phi_i' runs from 0 to 3.14"),
        (np.linspace(-np.pi, -np.pi / 3, 5), "'phi_i' runs from -3.14 to -1.05"),
        # half a turn without its end, and more than a quarter
        (np.linspace(-np.pi, 0, 6)[:-1], "'phi_i' runs from -3.14 to -0.628"),
        (np.linspace(-np.pi, -1.5, 5), "'phi_i' runs from -3.14 to -1.5"),
        (np.linspace(-np.pi / 2, -np.pi, 5), "'phi_i' does not rise"),
        (np.full(5, -np.pi), "'phi_i' does not rise"),
        (np.linspace(-np.pi, -np.pi / 2, 4), "'vndf' has shape .* beside 4 azimuths"),
    ],
    ids=range(7),
)
def test_azimuths_that_are_no_part_of_a_turn_are_refused(fields, phi_i, says):
    with pytest.raises(BrdfError, match=says):
        rgl_from_tensors(fields | {"phi_i": phi_i.astype("f4")})
