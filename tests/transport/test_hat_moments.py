"""Edge integrals of the dipole beside subdivision and brute quadrature over the triangle."""

from math import factorial

import numpy as np
import pytest

from prtbake_workers.transport import hat_moments as module
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.hat_moments import RULE_POINTS, RULE_WEIGHTS, hat_moments


def brute(dipole, point, corners, n=20):
    """Tensor Gauss over pieces that are halved until they are small for their distance."""
    nodes, weights = np.polynomial.legendre.leggauss(n)
    nodes, weights = (nodes + 1) / 2, weights / 2
    u, v = np.meshgrid(nodes, nodes, indexing="ij")
    area = np.outer(weights * nodes, weights)
    hats = np.stack([1 - u, u * (1 - v), u * v], axis=-1)
    path = dipole.mean_free_path.min()
    total = np.zeros((dipole.n_channels, 3))
    pieces = [(np.asarray(corners, np.float64), np.eye(3))]
    while pieces:
        tri, bary = pieces.pop()
        size = np.linalg.norm(tri - np.roll(tri, 1, axis=0), axis=1).max()
        near = max(np.linalg.norm(tri.mean(axis=0) - point) - 0.67 * size, 0.0)
        if size > 1.5 * np.hypot(near, path):
            mid, mid_b = (0.5 * (x + np.roll(x, -1, axis=0)) for x in (tri, bary))
            pieces += [
                (
                    np.stack([tri[i], mid[i], mid[i - 1]]),
                    np.stack([bary[i], mid_b[i], mid_b[i - 1]]),
                )
                for i in range(3)
            ]
            pieces.append((mid, mid_b))
            continue
        distance = np.linalg.norm(hats @ tri - point, axis=-1)
        profile = dipole.profile(distance.ravel()).reshape(-1, n, n)
        doubled = np.linalg.norm(np.cross(tri[1] - tri[0], tri[2] - tri[0]))
        total += np.einsum("cuv,uv,uvj->cj", profile, area * doubled, hats @ bary)
    return total


def points_about(rng, corners):
    a, b, c = corners
    return {
        "corner": a,
        "inside": (a + b + c) / 3,
        "on an edge": 0.4 * a + 0.6 * b,
        "in the plane, outside": a + 0.3 * (b - c),
        "close above an edge": 0.5 * (a + b) + 1e-4 * rng.normal(size=3),
        "above": (a + b + c) / 3 + 0.01 * rng.normal(size=3),
        "far": a + 3.0 * rng.normal(size=3),
    }


@pytest.mark.parametrize("path", [1e-6, 1e-2, 0.3, 3.0])
@pytest.mark.parametrize("absorption", [0.0, 0.05])
def test_weights_equal_brute_quadrature(rng, path, absorption):
    dipole = Dipole(np.array([1.0 / path]), np.array([absorption / path]), 1.3)
    corners = rng.normal(size=(3, 3))
    for where, point in points_about(rng, corners).items():
        found = hat_moments(dipole, point[None], corners[None])[:, 0]
        # 12 nodes an edge: the worst is a point just off the middle of an edge
        atol = 1e-3 if where == "close above an edge" else 1e-5
        expected = brute(dipole, point, corners)
        np.testing.assert_allclose(found, expected, atol=atol, rtol=1e-3, err_msg=where)


def test_a_point_sum_is_no_substitute(rng):
    """Negative twin: R_d at the corners times a third of the area, with a short path."""
    dipole = Dipole(np.array([100.0]), np.array([1.0]), 1.3)
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    found = hat_moments(dipole, corners[:1], corners[None])[0, 0].sum()
    distance = np.linalg.norm(corners - corners[0], axis=1)
    naive = dipole.profile(distance)[0].sum() * 0.5 / 3
    assert naive > 100 * found
    # a right angle is a quarter of the plane, up to what passes the far edge
    assert found == pytest.approx(0.25 * dipole.total_reflectance[0], rel=1e-3)


def test_weights_of_a_large_triangle_are_the_closed_form():
    """Seen from its centroid, a triangle of a million paths is the plane."""
    dipole = Dipole(np.array([1e6]), np.array([1e4]), 1.5)
    angles = np.array([0.0, 2.0, 4.0]) * np.pi / 3
    corners = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
    found = hat_moments(dipole, np.zeros((1, 3)), corners[None])[0, 0]
    np.testing.assert_allclose(found, dipole.total_reflectance[0] / 3, rtol=1e-9)


def test_halves_add_up(rng):
    """Weights of a triangle cut in two, hats recombined, are those of the whole."""
    dipole = Dipole.of_material("skin1", mm_per_unit=1.0)
    for _ in range(5):
        a, b, c = rng.normal(size=(3, 3))
        m, point = 0.5 * (b + c), 0.3 * rng.normal(size=3)
        whole, one, two = hat_moments(
            dipole, np.tile(point, (3, 1)), np.array([[a, b, c], [a, b, m], [a, m, c]])
        ).transpose(1, 0, 2)
        mid = one[:, 2] + two[:, 1]
        expected = np.stack(
            [one[:, 0] + two[:, 0], one[:, 1] + mid / 2, two[:, 2] + mid / 2], axis=1
        )
        # 12 nodes an edge
        np.testing.assert_allclose(whole, expected, atol=2e-5)


def test_the_plain_rule_is_of_degree_five():
    x, y = RULE_POINTS[:, 1], RULE_POINTS[:, 2]
    for i in range(6):
        for j in range(6 - i):
            exact = 2 * factorial(i) * factorial(j) / factorial(i + j + 2)
            assert RULE_WEIGHTS @ (x**i * y**j) == pytest.approx(exact, abs=1e-15)
    # degree six is not integrated
    assert abs(RULE_WEIGHTS @ x**6 - 2 * factorial(6) / factorial(8)) > 1e-5


def test_both_ways_agree_where_they_meet(rng, monkeypatch):
    dipole = Dipole.of_material("skin1", mm_per_unit=4.0)
    corners = rng.normal(size=(40, 3, 3))
    points = corners.mean(axis=1) + rng.normal(size=(40, 3))
    monkeypatch.setattr(module, "PLAIN_FROM", 2.0)
    mixed = hat_moments(dipole, points, corners)
    monkeypatch.setattr(module, "PLAIN_FROM", np.inf)
    edges = hat_moments(dipole, points, corners)
    monkeypatch.setattr(module, "PLAIN_FROM", 0.0)
    plain = hat_moments(dipole, points, corners)
    # degree 5 at twice the radius: a few parts in a thousand of a small weight
    np.testing.assert_allclose(mixed, edges, atol=1e-4)
    assert np.abs(plain - edges).max() > 1e-3


def test_few_nodes_serve_short_edges(rng, monkeypatch):
    """Six nodes where nothing changes much along an edge, twelve everywhere else."""
    dipole = Dipole.of_material("skin1", mm_per_unit=2.0)
    corners = rng.normal(size=(500, 3, 3))
    points = corners.mean(axis=1) + 0.3 * rng.normal(size=(500, 3))
    monkeypatch.setattr(module, "PLAIN_FROM", np.inf)
    mixed = hat_moments(dipole, points, corners)
    monkeypatch.setattr(module, "FEW_NODES", 40)
    monkeypatch.setattr(module, "N_NODES", 40)
    exact = hat_moments(dipole, points, corners)
    # 12 nodes leave 1e-6 of long edges here
    np.testing.assert_allclose(mixed, exact, atol=3e-6)
    # negative twin: six nodes for all edges
    monkeypatch.setattr(module, "FEW_NODES", 6)
    for name in ("SHORT_SPAN", "SHORT_TURN", "SHORT_FALL"):
        monkeypatch.setattr(module, name, np.inf)
    few = hat_moments(dipole, points, corners)
    assert np.abs(few - exact).max() > 1e-5


def test_slivers_keep_their_sum():
    """Rounding grows as length over height: hats stay inside, the sum stays exact."""
    dipole = Dipole(np.array([3.0]), np.array([0.1]), 1.3)
    for height in (1e-3, 1e-6, 1e-9):
        corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, height, 0.0]])
        found = hat_moments(dipole, np.array([[0.2, 0.1, 0.0]]), corners[None])[0, 0]
        s = (np.arange(4000) + 0.5) / 4000
        width = height * np.minimum(2 * s, 2 - 2 * s)
        profile = dipole.profile(np.hypot(s - 0.2, 0.1))[0]
        expected = (profile * width).mean()
        assert (found >= 0.0).all()
        # the sliver as a line of the triangle's width
        assert found.sum() == pytest.approx(expected, rel=1e-2)
