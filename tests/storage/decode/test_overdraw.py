import numpy as np
import pytest

from prtbake_storage.decode.overdraw import average_overdraw, triangle_overdraw
from support.grid_mesh import grid_faces


def test_it_counts_the_clusters_of_the_corners(rng):
    faces = rng.integers(0, 40, (300, 3)).astype(np.int32)
    labels = rng.integers(0, 5, 40).astype(np.int32)
    expected = [len({int(labels[corner]) for corner in triangle}) for triangle in faces]
    np.testing.assert_array_equal(triangle_overdraw(faces, labels), expected)
    assert average_overdraw(faces, labels) == np.mean(expected)
    assert average_overdraw(faces, (labels // 2).astype(np.int32)) < np.mean(expected)


@pytest.mark.parametrize("cut", [1, 3])
def test_two_halves_of_a_grid_draw_the_strip_between_them_twice(cut):
    side = 6
    labels = (np.arange(side * side) % side >= cut).astype(np.int32)
    strip = 2 * (side - 1)
    assert average_overdraw(grid_faces(side), labels) == 1.0 + strip / (2 * (side - 1) ** 2)


def test_every_vertex_a_cluster_draws_all_three_times():
    labels = np.arange(25, dtype=np.int32)
    assert average_overdraw(grid_faces(5), labels) == 3.0
    assert average_overdraw(grid_faces(5), np.zeros(25, np.int32)) == 1.0
    assert average_overdraw(np.zeros((0, 3), np.int32), labels) == 1.0
