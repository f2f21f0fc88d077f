import numpy as np
import pytest

from prtbake_workers.brdf.half_difference import directions_of, half_difference
from support.merl_file import directions as by_rotation


def test_angles_are_those_of_the_definition(directions):
    """Rotate wi by -phi_h about z and by -theta_h about y: d, whose angles they are."""
    wi, wo = directions(300), directions(300, seed=2)
    h = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    theta_h, phi_h = np.arccos(h[:, 2]), np.arctan2(h[:, 1], h[:, 0])
    c, s = np.cos(-phi_h), np.sin(-phi_h)
    x, y, z = wi[:, 0] * c - wi[:, 1] * s, wi[:, 0] * s + wi[:, 1] * c, wi[:, 2]
    c, s = np.cos(-theta_h), np.sin(-theta_h)
    dx, dz = x * c + z * s, z * c - x * s
    phi_d = np.arctan2(y, dx)
    got = half_difference(wi, wo)
    # the twin's arc cosines cost digits near the normal
    np.testing.assert_allclose(got.theta_h, theta_h, atol=1e-7)
    np.testing.assert_allclose(got.theta_d, np.arccos(dz), atol=1e-7)
    folded = np.abs(phi_d)
    folded = np.minimum(folded, np.pi - folded)
    np.testing.assert_allclose(got.phi_d, folded, atol=1e-7)
    assert np.abs(got.phi_d - np.abs(phi_d)).max() > 1.0


def test_exchange_and_mirror_image_have_the_same_angles(directions):
    wi, wo = directions(300), directions(300, seed=2)
    one, other = half_difference(wi, wo), half_difference(wo, wi)
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)
    flip = np.array([1.0, -1.0, 1.0])
    for a, b in zip(one, half_difference(wi * flip, wo * flip), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("turn", [0.4, 3.0])
def test_a_common_turn_changes_nothing(directions, turn):
    wi, wo = directions(100), directions(100, seed=2)
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    for a, b in zip(
        half_difference(wi, wo), half_difference(wi @ rotation, wo @ rotation), strict=True
    ):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_directions_come_back():
    rng = np.random.default_rng(3)
    h, d, p = (rng.random(200) * 1.5 + 0.01 for _ in range(3))
    wi, wo = directions_of(h, d, p)
    twin_i, twin_o = by_rotation(h, d, p)
    np.testing.assert_allclose(wi, twin_i, atol=1e-14)
    np.testing.assert_allclose(wo, twin_o, atol=1e-14)
    for got, want in zip(half_difference(wi, wo), (h, d, p), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-12)


def test_degenerate_pairs_have_finite_angles():
    up = np.array([0.0, 0.0, 1.0])
    grazing = np.array([1.0, 0.0, 1e-300])
    pairs = [(up, up), (grazing, grazing), (grazing, grazing * [-1, 1, 1]), (up, grazing)]
    wi, wo = (np.array(side) for side in zip(*pairs, strict=True))
    assert all(np.isfinite(angle).all() for angle in half_difference(wi, wo))
    assert half_difference(wi, wo).theta_h[0] == 0.0
    np.testing.assert_allclose(half_difference(wi, wo).theta_d[2], np.pi / 2)
