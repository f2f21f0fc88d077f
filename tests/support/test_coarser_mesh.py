import numpy as np
import pytest

from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.topology import find_edges
from support.coarser_mesh import coarser
from support.grid_mesh import sphere_faces


def _volume(positions, faces):
    a, b, c = positions[faces].transpose(1, 0, 2)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum()) / 6.0


def _ball():
    positions = icosphere(3)
    faces = sphere_faces(positions)
    a, b, c = positions[faces].transpose(1, 0, 2)
    inward = np.einsum("ij,ij->i", a, np.cross(b, c)) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return positions, faces


@pytest.mark.parametrize("n_faces", [1000, 500])
def test_a_ball_of_fewer_triangles_is_closed_and_no_smaller(n_faces):
    positions, faces = _ball()
    fewer, triangles = coarser(positions, faces, n_faces)
    assert len(triangles) == n_faces
    assert len(fewer) == n_faces // 2 + 2
    edges = find_edges(triangles.astype(np.int64))
    assert np.all(edges.n_faces_at == 2)
    assert not edges.clashing.any()
    # chords of a ball lie inside it: a coarse ball of n triangles lacks about 10 / n of it
    lacks = 1.0 - _volume(fewer, triangles) / (4.0 * np.pi / 3.0)
    assert 0.0 < lacks < 20.0 / n_faces
    assert 1.0 - _volume(positions, faces) / (4.0 * np.pi / 3.0) < lacks


def test_a_tetrahedron_cannot_lose_a_triangle():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    with pytest.raises(ValueError, match="no edge of 4 triangles"):
        coarser(positions, faces, 2)
