"""Albedo from vertex colours: interpolated at hits, and bled as a texture of the same colours."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from support.bounce_scenes import opaque, patch

LEFT, RIGHT = np.array([0.9, 0.1, 0.2]), np.array([0.1, 0.6, 0.8])
WALL = np.array([0.7, 0.7, 0.7])


@pytest.fixture(scope="module")
def nook():
    """A wall and a floor; the floor's u runs over the middle half of its texture."""
    wall = patch((-1, 0, -1), (2, 0, 0), (0, 2, 0), 4, 4)
    floor = patch((-1, 0, 1), (2, 0, 0), (0, 0, -2), 6, 6)
    uv = 0.25 + 0.5 * floor.uv
    return Scene.from_parts([wall, type(floor)(floor.positions, floor.faces, floor.normals, uv)])


@pytest.fixture(scope="module")
def texture():
    """Two texels, whose centres lie at u = 1/4 and 3/4: a linear ramp between."""
    return np.stack([LEFT, RIGHT])[None].astype(np.float32)


@pytest.fixture(scope="module")
def colours(nook):
    """The same ramp at the vertices of the floor."""
    start, stop = nook.part_ranges[1]
    u = (nook.uv[start:stop, :1] - 0.25) / 0.5
    return ((1 - u) * LEFT + u * RIGHT).astype(np.float32)


def operator(nook, albedo):
    surface = opaque(nook)
    block = build_bounce_block(surface, (0, nook.n_vertices), albedo=albedo, n_rays=64, seed=3)
    return [matrix.toarray() for matrix in block.matrices]


def test_a_floor_bleeds_as_a_texture_of_its_colours_does(nook, texture, colours):
    albedos = [WALL, np.ones(3)]
    of_vertices = Albedo.of_parts(nook, albedos, [None, None], [None, colours])
    of_texture = Albedo.of_parts(nook, albedos, [None, texture])
    # the largest colour is met at a vertex and at a texel's centre
    np.testing.assert_allclose(of_vertices.maximum, of_texture.maximum, rtol=1e-6)
    found, expected = operator(nook, of_vertices), operator(nook, of_texture)
    for one, other in zip(found, expected, strict=True):
        assert other.max() > 0.0
        # colours and texels in float32, the texture's weights too
        np.testing.assert_allclose(one, other, atol=1e-6 * other.max())
    # the negative twins: the mean of the floor, and its colours the other way round
    mean = colours.mean(axis=0).astype(np.float64)
    flat = operator(nook, Albedo.of_parts(nook, [WALL, mean], [None, None]))
    turned = operator(nook, Albedo.of_parts(nook, albedos, [None] * 2, [None, colours[::-1]]))
    for wrong in (flat, turned):
        assert np.abs(wrong[0] - expected[0]).max() > 0.05 * expected[0].max()


def test_texture_and_colours_multiply(nook, texture, colours):
    rng = np.random.default_rng(1)
    triangles = rng.integers(0, nook.n_faces, 200)
    weights = rng.dirichlet(np.ones(3), 200)
    values = [WALL, np.array([0.5, 1.0, 0.25])]

    def at(textures, of_vertices):
        return Albedo.of_parts(nook, values, textures, of_vertices).checked_at(triangles, weights)

    bare = at([None, None], None)
    both = at([None, texture], [None, colours])
    # the ramp meets itself
    np.testing.assert_allclose(both * bare, at([None, texture], None) ** 2, rtol=1e-5)
    on_wall = nook.part_of_face[triangles] == 0
    assert (both[on_wall] == WALL).all()
    assert np.abs(both[~on_wall] - bare[~on_wall]).min(axis=0).max() > 0.0


def test_they_agree_with_the_interpolation_of_all_vertices(nook, colours):
    """`of_vertices` numbers the scene's vertices; `of_parts` those of each part."""
    values = np.concatenate([np.tile(WALL, (nook.part_ranges[0][1], 1)), colours])
    one = Albedo.of_vertices(nook.faces, values.astype(np.float64))
    other = Albedo.of_parts(nook, [WALL, np.ones(3)], [None, None], [None, colours])
    triangles = np.repeat(np.arange(nook.n_faces), 3)
    weights = np.random.default_rng(2).dirichlet(np.ones(3), len(triangles))
    np.testing.assert_allclose(
        one.checked_at(triangles, weights), other.checked_at(triangles, weights), rtol=1e-12
    )


def test_grey_vertices_need_one_channel(nook, colours):
    grey = np.repeat(colours[:, :1], 3, axis=1)
    white = [np.ones(3), np.ones(3)]
    assert Albedo.of_parts(nook, white, [None] * 2, [None, grey]).n_channels == 1
    assert Albedo.of_parts(nook, white, [None] * 2, [None, colours]).n_channels == 3
    assert Albedo.of_parts(nook, white, [None] * 2, [None, 0 * colours]).maximum.tolist() == [1.0]


@settings(deadline=None, max_examples=40)
@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(0.0, 1.0))
def test_no_point_exceeds_the_maximum(nook, texture, seed, scale):
    rng = np.random.default_rng(seed)
    sizes = [stop - start for start, stop in nook.part_ranges]
    colours = [(scale * rng.random((size, 3))).astype(np.float32) for size in sizes]
    albedo = Albedo.of_parts(nook, [WALL, np.ones(3)], [None, texture], colours)
    triangles = rng.integers(0, nook.n_faces, 50)
    # refuses what lies outside
    values = albedo.checked_at(triangles, rng.dirichlet(np.ones(3), 50))
    assert (values >= 0.0).all()
    assert (values <= albedo.maximum).all()
