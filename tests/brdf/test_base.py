import numpy as np
import pytest

from prtbake_workers.brdf.base import (
    LENGTH_FLOOR,
    Brdf,
    channels,
    half_vector,
    is_isotropic,
    schlick,
)
from prtbake_workers.brdf.checks import check_energy, check_reciprocity


def plain_half(wi, wo):
    h = wi + wo
    return h / np.linalg.norm(h, axis=-1, keepdims=True)


def test_half_vector_angles_are_those_of_the_vector_itself(directions):
    wi, wo = directions(500), directions(500, seed=2)
    h = plain_half(wi, wo)
    half = half_vector(wi, wo)
    # three roundings a component
    np.testing.assert_allclose(half.cos_h, h[:, 2], rtol=1e-13)
    np.testing.assert_allclose(half.sin2_h, h[:, 0] ** 2 + h[:, 1] ** 2, rtol=1e-12, atol=1e-16)
    np.testing.assert_allclose(half.cos_d, np.sum(wo * h, axis=-1), rtol=1e-12)
    # twin: angles with the sum left unnormalised are not these
    assert np.abs(half.cos_h - (wi + wo)[:, 2]).max() > 0.1


def test_half_vector_of_opposite_directions_is_finite():
    wi = np.array([[1.0, 0.0, 0.0]])
    half = half_vector(wi, -wi)
    assert (half.cos_h[0], half.sin2_h[0]) == (1.0, 0.0)
    assert half.cos_d[0] <= LENGTH_FLOOR


def test_schlick_meets_its_ends():
    f = schlick(np.array([0.1, 0.5, 1.0]), np.array([0.0, 1.0, 0.5]))
    np.testing.assert_allclose(f[0], 1.0)
    np.testing.assert_allclose(f[1], [0.1, 0.5, 1.0])
    np.testing.assert_allclose(f[2], [0.1 + 0.9 / 32, 0.5 + 0.5 / 32, 1.0])


def test_channels_follow_the_most_coloured():
    grey, coloured = channels(0.5, (0.1, 0.2, 0.3))
    np.testing.assert_array_equal(grey, [0.5, 0.5, 0.5])
    np.testing.assert_array_equal(coloured, [0.1, 0.2, 0.3])
    assert [len(value) for value in channels(0.5, 0.1)] == [1, 1]


def test_every_model_keeps_the_contract(brdf, directions):
    wi, wo = directions(200), directions(200, seed=2)
    assert isinstance(brdf, Brdf)
    value = brdf.eval_brdf(wi[:, None], wo[None, :50])
    assert value.shape == (200, 50, brdf.n_channels)
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    np.testing.assert_array_equal(value[7, 3], brdf.eval_brdf(wi[7:8], wo[3:4])[0])
    down = wo * np.array([1.0, 1.0, -1.0])
    assert not brdf.eval_brdf(wi, down).any()
    assert not brdf.eval_brdf(down, wi).any()
    assert not brdf.eval_brdf(down, down).any()


def test_every_model_is_reciprocal_and_creates_no_light(brdf):
    assert check_reciprocity(brdf).reciprocal
    energy = check_energy(brdf, n_angles=9)
    assert energy.conserves
    assert energy.max_albedo > 0.05


@pytest.mark.parametrize("turn", [0.3, 2.0, -1.1])
def test_every_model_is_isotropic(brdf, directions, turn):
    assert is_isotropic(brdf)
    wi, wo = directions(100), directions(100, seed=2)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    # coordinates change in the last digit, which a lobe's exponent multiplies
    np.testing.assert_allclose(
        brdf.eval_brdf(wi @ rotation.T, wo @ rotation.T), brdf.eval_brdf(wi, wo), rtol=1e-11
    )
