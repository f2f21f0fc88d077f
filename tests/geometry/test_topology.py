"""Edges, pieces and winding."""

import numpy as np
import pytest

from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces
from prtbake_workers.geometry.topology import (
    around_edges,
    connected,
    consistent_winding,
    corners_that_meet,
    count_components,
    find_edges,
)

POINTS = icosphere(2)
FACES = icosphere_faces(2).astype(np.int64)


def volume(points, faces):
    a, b, c = (points[faces[:, i]] for i in range(3))
    return np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0


def turned(faces, flip):
    return np.where(flip[:, None], faces[:, ::-1], faces)


def test_closed_surface_has_only_manifold_edges():
    edges = find_edges(FACES)
    # Euler: V - E + F = 2
    assert len(edges.n_faces_at) == len(POINTS) + len(FACES) - 2
    assert (edges.n_boundary, edges.n_non_manifold, edges.clashing.sum()) == (0, 0, 0)


def test_boundary_and_non_manifold_edges_are_counted():
    fan = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    edges = find_edges(fan)
    assert (edges.n_boundary, edges.n_non_manifold) == (6, 1)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_shuffled_winding_is_made_consistent_and_outward(rng, share):
    flip = rng.random(len(FACES)) < share
    shuffled = turned(FACES, flip)
    edges = find_edges(shuffled)
    assert edges.clashing.any()
    winding = consistent_winding(POINTS, shuffled, edges, outward=True)
    assert winding.orientable
    assert (winding.flip == flip).all()


def test_majority_decides_where_outward_is_not_asked():
    shuffled = turned(FACES, np.arange(len(FACES)) % 4 != 0)
    winding = consistent_winding(POINTS, shuffled, find_edges(shuffled), outward=False)
    fixed = turned(shuffled, winding.flip)
    assert winding.n_inward_left == 1
    assert volume(POINTS, fixed) == pytest.approx(-volume(POINTS, FACES))


def test_each_piece_is_turned_for_itself():
    points = np.concatenate([POINTS, POINTS + np.array([10.0, 0.0, 0.0])])
    faces = np.concatenate([FACES[:, ::-1], FACES + len(POINTS)])
    winding = consistent_winding(points, faces, find_edges(faces), outward=True)
    assert winding.n_turned_outward == 1
    assert winding.flip[: len(FACES)].all()
    assert not winding.flip[len(FACES) :].any()
    assert count_components(faces) == 2


def test_open_pieces_keep_the_winding_of_their_majority():
    bowl = FACES[POINTS[FACES].mean(axis=1)[:, 1] < 0.0][:, ::-1]
    winding = consistent_winding(POINTS, bowl, find_edges(bowl), outward=True)
    assert not winding.flip.any()
    assert winding.n_turned_outward == 0


def moebius(n=12):
    """A strip of 2 n triangles with half a twist."""
    ring = np.arange(n)
    a, b = 2 * ring, 2 * ring + 1
    c, d = np.roll(a, -1), np.roll(b, -1)
    c[-1], d[-1] = b[0], a[0]
    return np.concatenate([np.stack([a, b, c], 1), np.stack([c, b, d], 1)])


def test_moebius_strip_is_not_orientable_and_stays():
    faces = moebius()
    points = np.random.default_rng(1).normal(size=(24, 3))
    winding = consistent_winding(points, faces, find_edges(faces), outward=True)
    assert not winding.orientable
    assert not winding.flip.any()


def test_two_cubes_on_one_edge_both_turn_outward():
    """Four faces meet at the edge; each piece is closed by itself."""
    points = np.concatenate([POINTS, 0.5 * POINTS])
    other = FACES + len(POINTS)
    # glue one edge of the small sphere to one of the large
    shared = {int(other[0, 0]): int(FACES[0, 0]), int(other[0, 1]): int(FACES[0, 1])}
    glued = np.vectorize(lambda i: shared.get(i, i))(other)
    faces = np.concatenate([FACES[:, ::-1], glued[:, ::-1]])
    edges = find_edges(faces)
    assert edges.n_non_manifold == 1
    winding = consistent_winding(points, faces, edges, outward=True)
    assert winding.n_turned_outward == 2
    assert winding.flip.all()


def test_around_edges_goes_round_once():
    fan = np.array([[0, 1, 2], [0, 1, 3], [1, 0, 4]])
    edges = find_edges(fan)
    halves, following = around_edges(edges)
    assert sorted(halves) == sorted(following) == list(range(9))
    after = dict(zip(halves.tolist(), following.tolist(), strict=True))
    # halves 0, 3 and 6 share the edge; the others have one of their own
    assert [after[0], after[3], after[6]] == [3, 6, 0]
    assert all(after[half] == half for half in (1, 2, 4, 5, 7, 8))
    # with a key the order is the key's
    key = np.zeros(9)
    key[[0, 3, 6]] = [2.0, 3.0, 1.0]
    after = dict(zip(*(side.tolist() for side in around_edges(edges, key)), strict=True))
    assert [after[6], after[0], after[3]] == [0, 3, 6]


@pytest.mark.parametrize("turn_over", [False, True])
def test_corners_meet_at_both_ends_whatever_the_winding(turn_over):
    """The corners paired lie at one vertex, at each end of every edge."""
    faces = FACES.copy()
    if turn_over:
        faces[::3] = faces[::3, ::-1]
    edges = find_edges(faces)
    assert edges.clashing.any() == turn_over
    left, right = corners_that_meet(edges, edges.pairs[:, 0], edges.pairs[:, 1])
    assert (faces.ravel()[left] == faces.ravel()[right]).all()
    assert (left // 3 != right // 3).all()
    # all corners at a vertex of a closed surface hang together, and no others
    component = connected(faces.size, left, right)
    assert len(np.unique(component)) == len(POINTS)
    assert (component <= np.arange(faces.size)).all()
    assert (faces.ravel()[component] == faces.ravel()).all()
