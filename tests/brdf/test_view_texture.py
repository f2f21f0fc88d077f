import numpy as np
import pytest

from prtbake_storage.contract.brdf import CookTorranceSpec, LambertSpec, PhongSpec
from prtbake_storage.decode.view_map import hemi_octahedral, lookup
from prtbake_storage.errors import SettingsError
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.brdf.view_texture import fit_view_texture, lookup_error, view_texture


@pytest.fixture(scope="module")
def gloss():
    return factorise(brdf_from_spec(CookTorranceSpec()), n_terms=16)


def error(gloss, texture, w):
    phi = gloss.eval_phi(w)
    got = lookup(texture, hemi_octahedral(w))
    cosine = w[:, 2, None, None]
    return np.linalg.norm((got - phi) * cosine) / np.linalg.norm(phi * cosine)


def test_lookup_gives_phi_back(gloss, directions):
    w = directions(3000)
    texture = view_texture(gloss, 64)
    assert texture.shape == (64, 64, 16, 1)
    assert texture.dtype == np.float32
    fine, coarse = error(gloss, texture, w), error(gloss, view_texture(gloss, 32), w)
    # measured 1.3e-2 and 5.0e-2, the weak terms most: second order in the texel.  In radiance,
    # where the singular values weigh the terms, 1.9e-3
    assert fine < 2e-2
    assert fine < 0.35 * coarse
    # twin: a texture seen through swapped axes
    assert error(gloss, texture.transpose(1, 0, 2, 3), w) > 0.1


def test_texels_are_averages(gloss):
    """Four samples of one texel are the texels of a texture twice as fine, sampled once."""
    fine = view_texture(gloss, 16, supersample=1)
    mean = fine.reshape(8, 2, 8, 2, 16, 1).mean(axis=(1, 3))
    np.testing.assert_allclose(view_texture(gloss, 8, supersample=2), mean, atol=1e-5)
    assert np.abs(view_texture(gloss, 8, supersample=1) - mean).max() > 1e-2


def test_small_passes_give_the_same(gloss, monkeypatch):
    whole = view_texture(gloss, 8, supersample=2)
    monkeypatch.setattr("prtbake_workers.brdf.view_texture.VALUES_A_PASS", 1)
    np.testing.assert_array_equal(view_texture(gloss, 8, supersample=2), whole)


def test_a_diffuse_view_side_is_flat():
    found = factorise(brdf_from_spec(LambertSpec(albedo=(0.5, 0.25, 0.125))))
    np.testing.assert_allclose(view_texture(found, 4), np.tile([0.5, 0.25, 0.125], (4, 4, 1, 1)))


@pytest.mark.parametrize(("resolution", "supersample"), [(1, 4), (8, 0)])
def test_impossible_sizes_are_refused(gloss, resolution, supersample):
    with pytest.raises(SettingsError, match=r"resolution|supersample"):
        view_texture(gloss, resolution, supersample)


@pytest.fixture(scope="module")
def narrow():
    return factorise(brdf_from_spec(PhongSpec(exponent=200)), n_terms=16)


def test_texels_are_as_fine_as_the_lobe_asks(gloss, narrow):
    assert fit_view_texture(gloss).resolution == 64
    fitted = fit_view_texture(narrow)
    # measured 2.1 %, 0.53 % and 0.13 % at 64, 128 and 256; orders up to 4 alone would ask for few
    assert fitted.resolution == 256
    assert 0.0 < fitted.error <= 0.003
    assert fitted.error == lookup_error(narrow, fitted.values)


def test_the_last_resolution_keeps_its_larger_error(narrow):
    fitted = fit_view_texture(narrow, largest=64)
    assert fitted.resolution == 64
    assert 0.015 < fitted.error < 0.025
    assert fit_view_texture(narrow, tolerance=0.01).resolution == 128


@pytest.mark.parametrize(("resolution", "supersample"), [(32, 4), (64, 1)])
def test_the_stated_error_is_that_of_radiance(gloss, directions, resolution, supersample):
    """Hold it against the double sum over pairs of directions, without any orthogonality."""
    texture = view_texture(gloss, resolution, supersample)
    wi, wo = directions(4000, seed=5), directions(3000, seed=6)
    psi = gloss.eval_psi(wi) * wi[:, 2:]
    phi = gloss.eval_phi(wo)[..., 0] * wo[:, 2:]
    seen = lookup(texture, hemi_octahedral(wo))[..., 0] * wo[:, 2:]
    expected = np.linalg.norm(psi @ (seen - phi).T) / np.linalg.norm(psi @ phi.T)
    # random directions on both sides: 5 % from seed to seed
    assert lookup_error(gloss, texture) == pytest.approx(expected, rel=0.15)
    # twin: terms that count alike, whichever their singular values
    assert error(gloss, texture, wo) > 2.0 * expected
