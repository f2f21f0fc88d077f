"""Spheres and grids."""

import numpy as np
import pytest

from prtbake_workers.geometry.mesh import face_area_vectors
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh


def test_sphere_stands_on_the_ground():
    mesh = sphere_mesh(2, radius=3.0)
    assert mesh.bounds[:, 1] == pytest.approx([0.0, 6.0])
    assert mesh.positions == pytest.approx(3.0 * (mesh.normals + np.array([0.0, 1.0, 0.0])))
    # inscribed, so a little less than 4 pi r^2
    assert 0.95 < mesh.vertex_areas.sum() / (36.0 * np.pi) < 1.0


@pytest.mark.parametrize(("columns", "rows"), [(1, 1), (3, 2), (8, 8)])
def test_grid_faces_up_and_covers_the_unit_square(columns, rows):
    mesh = grid_mesh(columns, rows)
    assert mesh.n_vertices == (columns + 1) * (rows + 1)
    assert mesh.n_faces == 2 * columns * rows
    vectors = face_area_vectors(mesh.positions, mesh.faces)
    assert vectors == pytest.approx(
        np.tile([0.0, 0.5 / (columns * rows), 0.0], (mesh.n_faces, 1)), abs=1e-15
    )
    assert mesh.uv == pytest.approx(
        np.stack([mesh.positions[:, 0] + 0.5, 0.5 - mesh.positions[:, 2]], axis=1)
    )
