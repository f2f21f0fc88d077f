"""Texels of a cube map against numerical integration and against each other."""

import numpy as np
import pytest

from prtbake_storage.decode.cube_map import cube_texel_of, cube_texels, face_solid_angles
from support.quadrature import random_directions


@pytest.mark.parametrize("resolution", [1, 2, 5])
def test_solid_angles_are_integrals_over_the_texels(resolution):
    """By Gauss-Legendre of |p|^-3 over each texel of the face at distance 1."""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    edges = np.linspace(-1.0, 1.0, resolution + 1)
    half = 1.0 / resolution
    middles = edges[:-1] + half
    at = middles[:, None] + half * nodes
    squares = at[:, :, None, None] ** 2 + at[None, None] ** 2 + 1.0
    expected = half**2 * np.einsum("i,aibj,j->ab", weights, squares**-1.5, weights)
    np.testing.assert_allclose(face_solid_angles(resolution), expected, rtol=1e-12)
    # negative twin: the one-point rule is off by percents on texels as large as these
    one_point = 4.0 * half**2 * (middles[:, None] ** 2 + middles**2 + 1.0) ** -1.5
    assert np.abs(one_point / expected - 1.0).max() > 0.01


@pytest.mark.parametrize(("resolution", "parts"), [(1, 1), (4, 1), (4, 3), (3, 2)])
def test_parts_lie_in_their_texels_and_cover_the_sphere(resolution, parts):
    directions, solid_angles, owners = cube_texels(resolution, parts)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-15)
    assert solid_angles.sum() == pytest.approx(4.0 * np.pi, rel=1e-14)
    np.testing.assert_array_equal(cube_texel_of(directions, resolution), owners)
    whole = np.bincount(owners, solid_angles)
    np.testing.assert_allclose(whole, np.tile(face_solid_angles(resolution).ravel(), 6), rtol=1e-12)


def test_a_direction_falls_into_the_texel_with_the_nearest_centre_of_its_face(rng):
    directions = random_directions(rng, 500)
    centres, _, _ = cube_texels(8)
    found = cube_texel_of(directions, 8)
    # on the cube's own face the nearest centre is that of the texel
    scaled = directions / np.abs(directions).max(axis=1, keepdims=True)
    points = centres / np.abs(centres).max(axis=1, keepdims=True)
    nearest = np.argmin(((scaled[:, None] - points) ** 2).sum(axis=2), axis=1)
    distance = ((scaled - points[found]) ** 2).sum(axis=1)
    least = ((scaled - points[nearest]) ** 2).sum(axis=1)
    # beyond an edge of the cube a texel of the next face may be as near
    same_face = found // 64 == nearest // 64
    assert same_face.mean() > 0.9
    np.testing.assert_allclose(distance[same_face], least[same_face], rtol=1e-12)
    # half a texel inside its own at most
    assert np.abs(scaled - points[found]).max() <= 1.0 / 8 + 1e-12
