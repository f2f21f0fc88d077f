"""The icosphere."""

import numpy as np
import pytest

from prtbake_workers.geometry.icosphere import icosphere, icosphere_faces


@pytest.mark.parametrize(
    ("subdivisions", "count"), list(enumerate([12, 42, 162, 642, 2562, 10242]))
)
def test_counts_and_unit_length(subdivisions, count):
    points = icosphere(subdivisions)
    faces = icosphere_faces(subdivisions)
    assert points.shape == (count, 3)
    assert faces.shape == (2 * count - 4, 3)
    assert np.abs(np.linalg.norm(points, axis=1) - 1.0).max() < 1e-15
    assert len(np.unique(np.round(points, 9), axis=0)) == count
    a, b, c = points[faces].transpose(1, 0, 2)
    assert np.einsum("ij,ij->i", a, np.cross(b, c)).min() > 0.0


def test_edges_of_the_icosahedron_are_equal():
    points = icosphere(0)
    edges = points[icosphere_faces(0)] - np.roll(points[icosphere_faces(0)], 1, axis=1)
    # edge of the icosahedron in the unit sphere
    assert np.linalg.norm(edges, axis=2) == pytest.approx(
        np.full((20, 3), 4.0 / np.sqrt(10.0 + 2.0 * np.sqrt(5.0))), rel=1e-14
    )


def test_nearest_neighbours_of_642_points():
    """numerics: 0.1384 to 0.1586 rad."""
    points = icosphere(3)
    cosines = points @ points.T - 2.0 * np.eye(642)
    nearest = np.arccos(cosines.max(axis=1))
    assert nearest.min() == pytest.approx(0.1384, abs=5e-5)
    assert nearest.max() == pytest.approx(0.1586, abs=5e-5)


def test_coarser_spheres_come_first():
    assert (icosphere(4)[:642] == icosphere(3)).all()


def test_callers_cannot_change_the_cache():
    icosphere(1)[:] = 0.0
    assert np.linalg.norm(icosphere(1), axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize("subdivisions", [-1, 9])
def test_bad_subdivisions_are_refused(subdivisions):
    with pytest.raises(ValueError, match="subdivisions must lie"):
        icosphere(subdivisions)
