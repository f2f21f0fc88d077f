"""How large clusters may look: against rows in which every triangle is integrated."""

import numpy as np
import pytest

from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.cluster_limit import (
    CLUSTER_SHARE,
    SOLID_ANGLES,
    ClusterLimit,
    choose_solid_angle,
    cluster_note,
)
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import SubsurfaceOperator

AXES = np.array([[0.6, 0.0, -0.8], [0.8, 1.0, 0.0], [0.0, 0.0, 0.6]])


@pytest.fixture(scope="module")
def ball():
    return Scene.from_parts([sphere_mesh(4)])


@pytest.fixture(scope="module")
def lit(ball):
    """Clamped cosines about three axes."""
    return np.maximum(0.0, ball.normals @ AXES).astype(np.float32)


def marble(path):
    one = Dipole.of_material("marble", mm_per_unit=1.0)
    return Dipole.of_material("marble", mm_per_unit=one.mean_free_path[0] / path)


def some(points, count=64):
    return points[np.random.default_rng(3).choice(len(points), count, replace=False)]


@pytest.mark.parametrize("path", [1e-3, 0.03, 0.1, 1.0])
@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4])
def test_the_error_is_as_said_and_within_its_share(ball, lit, path, tolerance):
    dipole = marble(path)
    limit = choose_solid_angle(ball, dipole, lit, some(ball.positions), tolerance=tolerance)
    operator = SubsurfaceOperator(ball, dipole, max_solid_angle=limit.solid_angle)
    rows = np.arange(0, ball.n_vertices, 80)
    true = operator.measured_error(lit, rows)
    # other vertices than were probed; what is below 1e-7 is what was dropped, the same in both
    assert true < 2.0 * limit.error + 1e-7
    assert limit.error < 2.0 * true + 1e-7
    if limit.solid_angle > SOLID_ANGLES[-1]:
        assert limit.error <= CLUSTER_SHARE * tolerance
    block = operator.block(rows)
    assert limit.entries == pytest.approx(block.matrices[0].nnz / len(rows), rel=0.1)


def test_the_next_larger_would_not_do(ball, lit):
    """Negative twin; and fewer entries are what a laxer tolerance buys."""
    points, dipole = some(ball.positions), marble(0.1)
    strict, lax = (choose_solid_angle(ball, dipole, lit, points, tolerance=t) for t in (1e-4, 1e-2))
    assert strict.solid_angle < lax.solid_angle
    assert strict.entries > 3.0 * lax.entries
    larger = SOLID_ANGLES[SOLID_ANGLES.index(strict.solid_angle) - 1]
    wider = SubsurfaceOperator(ball, dipole, max_solid_angle=larger)
    assert wider.measured_error(lit, np.arange(0, ball.n_vertices, 80)) > CLUSTER_SHARE * 1e-4


def test_no_angle_keeps_no_tolerance_and_any_serves_the_dark(ball, lit):
    points = some(ball.positions)
    none = choose_solid_angle(ball, marble(0.1), lit, points, tolerance=0.0)
    assert none.solid_angle == SOLID_ANGLES[-1]
    assert none.error > 0.0
    black = Dipole(np.array([0.0]), np.array([3.0]), 1.3)
    for dipole, transfer in ((black, lit), (marble(0.1), np.zeros_like(lit))):
        found = choose_solid_angle(ball, dipole, transfer, points, tolerance=1e-3)
        assert (found.solid_angle, found.error) == (SOLID_ANGLES[0], 0.0)


def test_a_limit_that_keeps_no_tolerance_is_said():
    limit = ClusterLimit(solid_angle=1.0 / 16.0, error=3e-5, entries=900.0)
    assert cluster_note("wax", limit, 4e-4) is None
    note = cluster_note("wax", limit, 1e-4)
    assert note.startswith(
        "wax: the smallest clusters, of 0.062 sr, are measured to err by 3.0e-05"
    )
