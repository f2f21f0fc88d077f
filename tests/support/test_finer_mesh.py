"""Cutting triangles leaves the surface alone; those shown are those that a picture shows."""

import numpy as np
import pytest

from support.bounce_scenes import ball, patch
from support.finer_mesh import finer, shown
from support.mitsuba_scenes import View


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_finer_triangles_cover_the_same_surface(rounds):
    mesh = ball(1)
    cut = finer(mesh, rounds)
    assert cut.n_faces == 4**rounds * mesh.n_faces
    # closed: each edge twice, once each way
    edges = cut.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert {tuple(edge) for edge in edges} == {tuple(edge[::-1]) for edge in edges}
    # the same triangles, not a rounder ball
    assert cut.vertex_areas.sum() == pytest.approx(mesh.vertex_areas.sum(), rel=1e-12)
    np.testing.assert_allclose(np.linalg.norm(cut.normals, axis=1), 1.0, rtol=1e-12)
    # of a ball at its middle, normals stay those of the positions within what flat edges leave
    towards = cut.positions / np.linalg.norm(cut.positions, axis=1, keepdims=True)
    assert ((towards * cut.normals).sum(axis=1) > 0.999).all()


def test_only_the_triangles_chosen_are_cut():
    mesh = ball(1)
    chosen = np.arange(mesh.n_faces) % 3 == 0
    cut = finer(mesh, 2, chosen)
    assert cut.n_faces == (~chosen).sum() + 16 * chosen.sum()
    np.testing.assert_array_equal(cut.faces[: (~chosen).sum()], mesh.faces[~chosen])
    np.testing.assert_array_equal(cut.positions[: mesh.n_vertices], mesh.positions)
    assert cut.vertex_areas.sum() == pytest.approx(mesh.vertex_areas.sum(), rel=1e-12)


def test_what_is_shown_faces_the_eye_and_is_not_hidden():
    view = View((0.0, 0.0, 6.0), (0.0, 0.0, 0.0), 40.0, width=12, height=12)
    mesh, hidden = ball(2), patch([-0.5, -0.5, -2], [1, 0, 0], [0, 1, 0], 2, 2)
    seen, behind = shown([mesh, hidden], view, 8)
    towards = mesh.positions[mesh.faces].mean(axis=1) @ [0.0, 0.0, 1.0]
    assert not behind.any()
    # the eye sees a little less than half a ball: down to a height of 1/6
    assert not seen[towards < 0.0].any()
    assert seen[towards > 0.5].all()
