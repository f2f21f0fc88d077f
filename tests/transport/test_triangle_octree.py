"""The octree over triangles: a partition at every depth, with the moments it claims."""

import numpy as np
import pytest

from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.transport.triangle_octree import MAX_LEVEL, build_triangle_octree


def soup(rng, n_triangles):
    """Triangles of their own vertices, of all sizes."""
    size = 10.0 ** rng.uniform(-3, 0, (n_triangles, 1, 1))
    corners = rng.normal(size=(n_triangles, 1, 3)) + size * rng.normal(size=(n_triangles, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * n_triangles, dtype=np.int32).reshape(-1, 3)


def members(tree, node):
    """Triangles below a node, by walking down."""
    if tree.triangles[node] >= 0:
        return [int(tree.triangles[node])]
    first = int(tree.first_child[node])
    return [
        triangle
        for child in range(first, first + int(tree.n_children[node]))
        for triangle in members(tree, child)
    ]


@pytest.mark.parametrize("n_triangles", [1, 2, 8, 9, 300])
def test_every_triangle_is_once_below_the_root(rng, n_triangles):
    positions, faces = soup(rng, n_triangles)
    tree = build_triangle_octree(positions, faces)
    assert sorted(members(tree, 0)) == list(range(n_triangles))
    single = tree.triangles >= 0
    assert single.sum() == n_triangles
    assert not tree.n_children[single].any()
    # no chains: every other node splits
    assert (tree.n_children[~single] >= 2).all()
    assert tree.n_children.sum() == tree.n_nodes - 1


def test_nodes_have_the_moments_of_their_members(rng):
    positions, faces = soup(rng, 120)
    tree = build_triangle_octree(positions, faces)
    values = rng.normal(size=(len(positions), 4))
    means = tree.means @ values
    # the midpoints of the sides integrate second degrees exactly
    corners = positions[faces]
    middles = 0.5 * (corners + np.roll(corners, -1, axis=1))
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    for node in range(tree.n_nodes):
        own = members(tree, node)
        weight = areas[own] / areas[own].sum()
        assert tree.areas[node] == pytest.approx(areas[own].sum(), rel=1e-12)
        centre = weight @ corners[own].mean(axis=1)
        np.testing.assert_allclose(tree.centres[node], centre, atol=1e-12)
        np.testing.assert_allclose(
            means[node], weight @ values[faces[own]].mean(axis=1), atol=1e-12
        )
        apart = middles[own] - centre
        spread = np.einsum("t,tki,tkj->ij", weight / 3, apart, apart)
        np.testing.assert_allclose(tree.spreads[node], spread, atol=1e-12)
        furthest = np.linalg.norm(corners[own] - centre, axis=2).max()
        assert furthest <= tree.radii[node] * (1 + 1e-12)
        # the reach of a member about its own centroid counts twice at most
        assert tree.radii[node] <= 3.0 * furthest


def test_size_and_place_do_not_matter(rng):
    positions, faces = soup(rng, 200)
    one = build_triangle_octree(positions, faces)
    other = build_triangle_octree(1e6 * positions, faces)
    np.testing.assert_array_equal(other.triangles, one.triangles)
    np.testing.assert_allclose(other.areas, 1e12 * one.areas, rtol=1e-9)


def test_depth_follows_the_logarithm():
    depths = []
    for subdivisions in (2, 3, 4):
        mesh = sphere_mesh(subdivisions)
        tree = build_triangle_octree(mesh.positions, mesh.faces)
        depths.append(tree.means.nnz / tree.n_nodes)
        # singles, and a cluster to a few of them
        assert tree.n_nodes < 1.6 * mesh.n_faces
    assert depths[2] - depths[1] < 1.6 * (depths[1] - depths[0]) + 6


def test_triangles_at_one_place_are_split_at_last():
    """Equal centroids share every cell down to the last level."""
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    positions = np.concatenate([np.tile(corners, (50, 1)), corners + 3.0])
    faces = np.arange(153, dtype=np.int32).reshape(-1, 3)
    tree = build_triangle_octree(positions, faces)
    assert sorted(members(tree, 0)) == list(range(51))
    assert tree.n_children.max() == 50
    assert MAX_LEVEL * 3 <= 62


def test_triangles_without_area_are_left_out():
    positions = np.array([[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [2.0, 0, 0]])
    faces = np.array([[0, 1, 2], [0, 1, 3], [1, 1, 2]], dtype=np.int32)
    tree = build_triangle_octree(positions, faces)
    assert tree.n_nodes == 1
    assert tree.triangles.tolist() == [0]
    nothing = build_triangle_octree(positions, faces[1:])
    assert nothing.n_nodes == 0
    assert nothing.means.shape == (0, 4)
