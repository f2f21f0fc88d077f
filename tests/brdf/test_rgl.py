import numpy as np
import pytest

from prtbake_storage.errors import BrdfError
from prtbake_workers.brdf.checks import check_energy, check_reciprocity
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.ggx import Ggx
from prtbake_workers.brdf.rgl import CHUNK
from prtbake_workers.brdf.rgl_fields import rgl_from_tensors
from prtbake_workers.brdf.symmetrised import Symmetrised
from prtbake_workers.brdf.tensor_file import read_tensor_file
from support.tensor_file import ggx_fields, tensor_bytes

ALPHA = 0.4
GGX = Ggx(np.zeros(3), np.ones(3), ALPHA, np.array([0.9, 0.5, 0.2]))


@pytest.fixture(scope="module")
def fields():
    return ggx_fields(GGX, ALPHA)


@pytest.fixture(scope="module")
def tensor(fields):
    return rgl_from_tensors(read_tensor_file(tensor_bytes(fields)))[0]


def error(brdf, directions, inside=0.0, n=20_000):
    """Relative L2, cosine-weighted, over pairs with both cosines above ``inside``."""
    wi, wo = directions(n), directions(n, seed=2)
    kept = (wi[:, 2] > inside) & (wo[:, 2] > inside)
    wi, wo = wi[kept], wo[kept]
    weight = (wi[:, 2] * wo[:, 2])[:, None]
    exact = GGX.eval_brdf(wi, wo)
    return np.linalg.norm((brdf.eval_brdf(wi, wo) - exact) * weight) / np.linalg.norm(
        exact * weight
    )


def test_a_tabulated_ggx_is_ggx(tensor, directions):
    """9 angles of light up to 85 degrees, 32 x 32 values, 24 x 96 normals; bilinear."""
    assert error(tensor, directions, inside=0.26) < 6e-3
    assert error(tensor, directions) < 0.03
    # beyond the last angle of light its slice is held, so that grazing light has the larger error
    assert error(tensor, directions) > error(tensor, directions, inside=0.26)


def test_the_error_falls_with_finer_tables(directions):
    coarse = rgl_from_tensors(ggx_fields(GGX, ALPHA, n_lights=4, n=8, n_normals=24, n_rows=8))[0]
    fine = rgl_from_tensors(ggx_fields(GGX, ALPHA, n_lights=8, n=16, n_normals=48, n_rows=16))[0]
    assert error(fine, directions, 0.26) < 0.5 * error(coarse, directions, 0.26)


@pytest.mark.parametrize("broken", ["sigma", "ndf", "vndf", "transposed"])
def test_every_field_has_its_part(fields, directions, broken):
    """Negative twins: a wrong table in any place is a wrong BRDF."""
    wrong = dict(fields)
    if broken == "transposed":
        wrong["rgb"] = fields["rgb"].swapaxes(3, 4)
    else:
        wrong[broken] = np.ones_like(fields[broken])
    assert error(rgl_from_tensors(wrong)[0], directions, 0.26) > 0.03


def test_a_common_turn_changes_nothing(tensor, directions):
    wi, wo = directions(200), directions(200, seed=2)
    c, s = np.cos(2.0), np.sin(2.0)
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(
        tensor.eval_brdf(wi @ rotation, wo @ rotation), tensor.eval_brdf(wi, wo), rtol=1e-9
    )


def test_chunks_join(tensor, directions):
    wi, wo = directions(CHUNK + 5), directions(CHUNK + 5, seed=2)
    whole = tensor.eval_brdf(wi, wo)
    np.testing.assert_array_equal(whole[-3:], tensor.eval_brdf(wi[-3:], wo[-3:]))


def test_made_symmetric_it_serves_transfer(tensor, directions):
    assert not check_reciprocity(tensor).reciprocal
    brdf = Symmetrised(tensor)
    assert check_reciprocity(brdf).max_relative == 0.0
    assert error(brdf, directions, inside=0.26) < 6e-3
    grid = {"n_terms": 16, "n_theta": 14, "n_phi": 56, "n_nodes": 17}
    found, model = factorise(brdf, **grid), factorise(GGX, **grid)
    assert found.energy_lost == pytest.approx(model.energy_lost, rel=0.05)
    report = check_energy(brdf, n_angles=2)
    assert report.conserves
    np.testing.assert_allclose(
        report.normal_albedo, check_energy(GGX, n_angles=2).normal_albedo, rtol=5e-3
    )


def test_grazing_light_and_view_are_finite(tensor):
    cos = np.array([1e-300, 1e-30, 1e-12, 1e-6, 1e-3, 0.3, 1.0])
    sin = np.sqrt(1 - cos * cos)
    wi = np.stack([sin, 0 * sin, cos], axis=-1)[:, None]
    for phi in (0.0, 1e-9, 1.0, np.pi):
        wo = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], axis=-1)[None]
        for brdf in (tensor, Symmetrised(tensor)):
            value = brdf.eval_brdf(wi, wo)
            assert np.isfinite(value).all()
            assert (value >= 0.0).all()
    below = np.array([[0.6, 0.0, -0.8]])
    assert not tensor.eval_brdf(wi[-1], below).any()


def test_two_azimuths_of_an_isotropic_file_are_averaged(fields, tensor, directions):
    double = dict(fields)
    double["phi_i"] = np.array([-np.pi, np.pi], "f4")
    for name in ("vndf", "rgb"):
        double[name] = np.repeat(fields[name], 2, axis=0)
    double["rgb"] = double["rgb"] * np.array([0.9, 1.1], "f4").reshape(2, 1, 1, 1, 1)
    wi, wo = directions(50), directions(50, seed=2)
    np.testing.assert_allclose(
        rgl_from_tensors(double)[0].eval_brdf(wi, wo), tensor.eval_brdf(wi, wo), rtol=1e-5
    )


def test_noise_below_zero_is_cut_and_counted(fields):
    noisy = dict(fields) | {"rgb": fields["rgb"].copy()}
    noisy["rgb"][0, 3, 1, 4, 5] = -0.01
    tensor, report = rgl_from_tensors(noisy)
    assert (report["n_negative"], report["n_lights"]) == (1, 9)
    assert report["most_negative"] == pytest.approx(-0.01)
    assert report["resolution"] == [32, 32]
    assert tensor.rgb.min() == 0.0


def cut(name, part):
    return lambda fields: fields | {name: fields[name][part]}


def spoiled(name, value):
    def change(fields):
        array = fields[name].copy()
        array[..., 1] = value
        return fields | {name: array}

    return change


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda f: {k: v for k, v in f.items() if k != "ndf"}, "lacks ndf"),
        (
            lambda f: {k: v for k, v in f.items() if k != "rgb"} | {"spectra": f["rgb"]},
            "holds spectra",
        ),
        (lambda f: f | {"phi_i": np.linspace(0, 1, 8).astype("f4")}, "beside 8 azimuths"),
        (cut("theta_i", slice(0, 5)), "'vndf' has shape .* beside 1 azimuths and 5 angles"),
        (lambda f: f | {"theta_i": f["theta_i"][::-1]}, "does not rise"),
        (lambda f: f | {"rgb": f["rgb"][:, :, :2]}, "has 2 channels"),
        (lambda f: f | {"ndf": f["ndf"][:1]}, "'ndf' .* too small"),
        (lambda f: f | {"sigma": f["sigma"][:, :1]}, "'sigma' .* too small"),
        (lambda f: f | {"vndf": f["vndf"][0]}, "'vndf' is float32 of shape .* with 4 axes"),
        (lambda f: f | {"ndf": f["ndf"].astype("u4")}, "'ndf' is uint32"),
        (lambda f: f | {"theta_i": np.zeros(0, "f4")}, "'theta_i' .* too small"),
        (spoiled("rgb", np.nan), r"'rgb' is not finite at \(0, 0, 0, 0, 1\)"),
        (spoiled("ndf", -1.0), "ndf holds negative"),
        (spoiled("sigma", -1.0), "sigma holds negative"),
        (lambda f: f | {"vndf": 0 * f["vndf"]}, r"'vndf' is zero .* at theta_i 0 deg"),
        (lambda f: f | {"jacobian": np.zeros(1, "u1")}, "'jacobian' is not 1"),
    ],
    ids=range(16),
)
def test_a_refusal_names_the_field(fields, change, says):
    with pytest.raises(BrdfError, match=says):
        rgl_from_tensors(change(dict(fields)))
