"""Cutting polygons into triangles."""

import numpy as np
import pytest

from prtbake_workers.geometry.polygons import triangulate


def signed_areas(points, triangles):
    a, b, c = (points[triangles[:, i]] for i in range(3))
    return 0.5 * np.cross(b - a, c - a) @ np.array([0.0, 0.0, 1.0])


def cut(points, turn=None):
    points = np.asarray(points, np.float64)
    flat = np.column_stack([points, np.zeros(len(points))])
    placed = flat if turn is None else flat @ turn.T
    triangles, _ = triangulate(placed, np.arange(len(points)), np.array([len(points)]))
    return flat, triangles


L_SHAPE = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
# the fan about corner 0 leaves this one
ARROW = [(0, 2), (-1, 0), (0, 1), (1, 0)]
COMB = [
    (0, 0),
    (5, 0),
    (5, 3),
    (4, 3),
    (4, 1),
    (3, 1),
    (3, 3),
    (2, 3),
    (2, 1),
    (1, 1),
    (1, 3),
    (0, 3),
]


@pytest.mark.parametrize(("ring", "area"), [(L_SHAPE, 3.0), (ARROW, 1.0), (COMB, 11.0)])
@pytest.mark.parametrize("start", range(4))
@pytest.mark.parametrize("axis", range(3))
def test_concave_polygons_are_covered_once(ring, area, start, axis):
    # every starting corner, and every plane that the cut can be projected to
    turn = np.roll(np.eye(3), axis, axis=0)
    points, triangles = cut(ring[start:] + ring[:start], turn)
    assert len(triangles) == len(ring) - 2
    areas = signed_areas(points, triangles)
    assert (areas > 0.0).all()
    assert areas.sum() == pytest.approx(area, rel=1e-12)


def test_a_fan_would_not_cover_the_comb_once():
    points = np.column_stack([np.array(COMB, float), np.zeros(len(COMB))])
    fan = np.array([(0, i, i + 1) for i in range(1, len(COMB) - 1)])
    assert (signed_areas(points, fan) < 0.0).any()


def test_clockwise_rings_stay_clockwise():
    points, triangles = cut(L_SHAPE[::-1])
    assert signed_areas(points, triangles) == pytest.approx(
        -np.abs(signed_areas(points, triangles))
    )


def test_convex_polygons_become_fans_in_order():
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    _, triangles = cut(np.column_stack([np.cos(angles), np.sin(angles)]))
    assert triangles.tolist() == [[0, i, i + 1] for i in range(1, 15)]


def test_mixed_polygons_keep_their_order_and_source():
    positions = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [2, 0, 0]])
    corners = np.array([0, 1, 2, 3, 1, 4, 2, 0, 1, 3])
    triangles, source = triangulate(positions, corners, np.array([4, 3, 3]))
    assert source.tolist() == [0, 0, 1, 2]
    assert corners[triangles].tolist() == [[0, 1, 2], [0, 2, 3], [1, 4, 2], [0, 1, 3]]


def test_crossing_rings_end_and_keep_the_count():
    _, triangles = cut([(0, 0), (1, 1), (1, 0), (0, 1), (0.5, 3), (-2, -1)])
    assert len(triangles) == 4


def test_no_polygons():
    triangles, source = triangulate(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    assert triangles.shape == (0, 3)
    assert source.shape == (0,)
