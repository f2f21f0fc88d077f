"""Subsurface scattering beside closed forms, 1-D quadrature and a dense double sum."""

import itertools

import numpy as np
import pytest
from scipy.integrate import quad

from prtbake_storage.errors import SettingsError
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport import subsurface
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import SubsurfaceOperator
from support.bounce_scenes import patch


def skin(path, scene_size=1.0):
    """The material skin1 with its longest mean free path at a length of the scene."""
    one = Dipole.of_material("skin1", mm_per_unit=1.0)
    return Dipole.of_material("skin1", mm_per_unit=one.mean_free_path[0] / path / scene_size)


def plane(n, size=1.0):
    return Scene.from_parts([patch([-size / 2, 0, size / 2], [size, 0, 0], [0, 0, -size], n, n)])


def middle(scene):
    return np.array([np.argmin(np.linalg.norm(scene.positions, axis=1))])


def total_albedo(dipole):
    return dipole.entering_transmittance * dipole.total_reflectance


def dense_twin(scene, dipole, transfer, vertices, levels=4):
    """The double sum over triangles cut into 4^k, at two depths, extrapolated to none."""
    entering = dipole.entering_transmittance
    results = []
    for level in (levels - 1, levels):
        corners = scene.positions[scene.faces]
        values = transfer[scene.faces].astype(np.float64)
        for _ in range(level):
            pieces = []
            for x in (corners, values):
                m = 0.5 * (x + np.roll(x, -1, axis=1))
                pieces.append(
                    np.concatenate(
                        [
                            np.stack([x[:, 0], m[:, 0], m[:, 2]], axis=1),
                            np.stack([x[:, 1], m[:, 1], m[:, 0]], axis=1),
                            np.stack([x[:, 2], m[:, 2], m[:, 1]], axis=1),
                            m,
                        ]
                    )
                )
            corners, values = pieces
        sides = corners[:, 1:] - corners[:, :1]
        areas = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        centres, mean = corners.mean(axis=1), values.mean(axis=1)
        result = np.empty((dipole.n_channels, len(vertices), transfer.shape[1]))
        for row, vertex in enumerate(vertices):
            distance = np.linalg.norm(centres - scene.positions[vertex], axis=1)
            result[:, row] = entering * (dipole.profile(distance) * areas) @ mean
        results.append(result)
    return (4.0 * results[1] - results[0]) / 3.0


@pytest.fixture
def ball():
    return Scene.from_parts([sphere_mesh(2)])


@pytest.fixture
def smooth(ball):
    y = ball.normals
    columns = [
        np.ones(len(y)),
        np.maximum(0, y[:, 1]),
        y[:, 0] * y[:, 2],
        1.0 + np.sin(4 * y[:, 0]),
    ]
    return np.stack(columns, axis=1).astype(np.float32)


@pytest.mark.parametrize("path", [0.2, 0.5, 2.0])
def test_rows_equal_the_dense_double_sum(ball, smooth, path):
    """All triangles integrated: only quadrature and float32 are left."""
    dipole = skin(path)
    operator = SubsurfaceOperator(ball, dipole, max_solid_angle=0.0, dropped_share=0.0)
    vertices = np.array([0, 5, 77, 161])
    block = operator.block(vertices)
    assert block.n_clusters == 0
    assert block.n_triangles == 4 * ball.n_faces
    found = np.stack([m @ operator.sources(smooth) for m in block.matrices])
    expected = dense_twin(ball, dipole, smooth, vertices)
    # extrapolated sums over pieces of 1/16 of 0.3: (0.02 / path)^4
    np.testing.assert_allclose(found, expected, atol=1e-4 * total_albedo(dipole).max())
    # negative twin: transfer of the next vertex
    wrong = np.stack([m @ operator.sources(np.roll(smooth, 1, axis=0)) for m in block.matrices])
    assert np.abs(wrong - expected).max() > 1e-2 * total_albedo(dipole).max()


@pytest.mark.parametrize("path", [0.03, 0.2, 2.0])
def test_clusters_stay_within_their_bound(rng, path):
    scene = Scene.from_parts([sphere_mesh(4)])
    dipole = skin(path)
    transfer = rng.uniform(-1.0, 1.0, (scene.n_vertices, 3)).astype(np.float32)
    transfer[:, 0] = 1.0
    rows = np.arange(0, scene.n_vertices, 500)
    operator = SubsurfaceOperator(scene, dipole)
    block = operator.block(rows, with_bound=True)
    exact = SubsurfaceOperator(scene, dipole, max_solid_angle=0.0, dropped_share=0.0).block(rows)
    sources = operator.sources(transfer)
    total = total_albedo(dipole)
    for channel in range(3):
        error = np.abs((block.matrices[channel] - exact.matrices[channel]) @ sources)
        # float32 sums of 1,000 terms
        assert (error.max(axis=1) <= block.bound[channel] + 1e-5 * total[channel]).all()
        # even transfer: clusters are of second order, and leave far less than what was dropped
        assert error[:, 0].max() < 1e-3 * total[channel]
        # and the bound is not idle
        assert block.bound[channel].max() < 3.0 * total[channel]
    assert block.n_clusters < 0.3 * exact.n_triangles


def test_the_error_falls_with_the_solid_angle(ball):
    scene = Scene.from_parts([sphere_mesh(4)])
    y = scene.normals
    transfer = np.maximum(0.0, y @ np.array([[0.6, 0.0], [0.8, 1.0], [0.0, 0.0]])).astype(
        np.float32
    )
    rows = np.arange(0, scene.n_vertices, 500)
    errors = [
        SubsurfaceOperator(scene, skin(0.2), max_solid_angle=angle).measured_error(transfer, rows)
        for angle in (1.0, 0.3, 0.1)
    ]
    assert errors[0] > 3.0 * errors[1] > 9.0 * errors[2]
    # the default: 0.5 % of the amplitude
    assert errors[1] < 2.5e-5


def test_a_plane_under_even_light_is_evenly_bright():
    """R_d total, less what a disc about the middle cannot hold and a wider one can."""
    scene, dipole = plane(40), skin(0.01)
    operator = SubsurfaceOperator(scene, dipole)
    (row,) = middle(scene)
    result = operator.apply(np.ones((scene.n_vertices, 1), np.float32))
    inner, outer = dipole.disc_reflectance(np.array([0.5, np.sqrt(0.5)])).T
    entering = dipole.entering_transmittance
    found = result.transfer[:, row, 0]
    # clusters and the dropped share: 1e-4 each
    assert (found >= entering * inner - 3e-4 * total_albedo(dipole)).all()
    assert (found <= entering * outer + 3e-4 * total_albedo(dipole)).all()
    np.testing.assert_allclose(found, total_albedo(dipole), rtol=2e-3)
    assert result.report.albedo == pytest.approx(total_albedo(dipole))
    # the sampling distance: 41 vertices to the side
    assert result.report.resolution[0] == pytest.approx(0.41)
    # negative twin: vertices as points with their areas, where the path is below their distance
    distance = np.linalg.norm(scene.positions - scene.positions[row], axis=1)
    points = entering * dipole.profile(distance) @ scene.areas
    assert np.abs(points / total_albedo(dipole) - 1.0).max() > 0.1


@pytest.mark.parametrize("path", [0.004, 0.02, 0.05])
def test_an_edge_of_light_is_the_line_spread(path):
    """T rises over one cell of the grid; beside it R_d integrated along lines, then across."""
    n = 60
    scene, dipole = plane(n), skin(path)
    x = scene.positions[:, 0]
    transfer = np.clip(n * x, 0.0, 1.0).astype(np.float32)[:, None]
    rows = np.flatnonzero((np.abs(scene.positions[:, 2]) < 1e-9) & (np.abs(x) < 0.2))
    operator = SubsurfaceOperator(scene, dipole, max_solid_angle=0.05)
    sources = operator.sources(transfer)
    found = np.stack([(m @ sources)[:, 0] for m in operator.block(rows).matrices])
    widest = max(dipole.depths.max(), 1e-3)
    for channel in range(3):

        def line(u, channel=channel):
            """R_d along the line at u, to the borders of the patch."""
            s = np.linspace(0.0, np.arcsinh(0.5 / widest), 400)
            t = widest * np.sinh(s)
            values = dipole.profile(np.hypot(u, t))[channel] * widest * np.cosh(s)
            return 2.0 * np.trapezoid(values, s)

        for index in range(0, len(rows), 4):
            at = x[rows[index]]
            inner = [p for p in (0.0, 1 / n, at) if 0.0 < p < 0.5]
            edges = np.concatenate([[0.0], np.sort(inner), [0.5]])
            expected = sum(
                quad(lambda u, at=at: line(u - at) * np.clip(n * u, 0, 1), lo, hi, limit=60,
                     epsabs=1e-6, epsrel=1e-5)[0]
                for lo, hi in itertools.pairwise(edges)
            )  # fmt: skip
            expected *= dipole.entering_transmittance
            # clusters hold T's mean, not its slope, so a step is hard on them
            atol = 1e-3 * total_albedo(dipole)[channel]
            assert found[channel, index] == pytest.approx(expected, abs=atol)
    # light bleeds into the dark side, and only there where the path is long enough
    dark = found[0, x[rows] < -0.05]
    assert (dark.max() > 1e-2 * total_albedo(dipole)[0]) == (path >= 0.02)


def test_the_limit_of_a_short_path_is_the_albedo_times_the_transfer(smooth, ball):
    """Up to 2 / n of the full turn, which the corners of the sphere's polyhedron lack."""
    for path in (1e-3, 1e-6):
        dipole = skin(path)
        result = SubsurfaceOperator(ball, dipole).apply(smooth)
        expected = total_albedo(dipole)[:, None, None] * smooth
        # 162 corners share 4 pi: each lacks 1.2 % of its turn, those of five triangles more
        np.testing.assert_allclose(
            result.transfer, expected, rtol=0.02, atol=0.02 * total_albedo(dipole).max()
        )
        assert max(result.report.resolution) < 0.01
    # negative twin: with a long path it is not
    far = SubsurfaceOperator(ball, skin(1.0)).apply(smooth)
    assert np.abs(far.transfer - expected).max() > 0.1 * total_albedo(dipole).max()


def test_no_light_is_made():
    """Even light on a convex body: exitance nowhere above the albedo, and the total is below it."""
    scene = Scene.from_parts([sphere_mesh(3)])
    for path in (1e-4, 0.03, 0.3):
        dipole = skin(path)
        out = SubsurfaceOperator(scene, dipole).apply(np.ones((scene.n_vertices, 1), np.float32))
        assert (out.transfer.max(axis=(1, 2)) <= total_albedo(dipole) * (1 + 1e-3)).all()


def test_coefficients_do_not_mix(ball, smooth, rng):
    operator = SubsurfaceOperator(ball, skin(0.3))
    whole = operator.apply(smooth).transfer
    mixed = operator.apply((smooth @ np.array([[2.0], [0.5], [-1.0], [3.0]])).astype(np.float32))
    expected = whole @ np.array([2.0, 0.5, -1.0, 3.0])
    # sums of float32
    np.testing.assert_allclose(mixed.transfer[..., 0], expected, atol=1e-5)
    many = operator.apply(rng.normal(size=(ball.n_vertices, 150)).astype(np.float32))
    assert many.transfer.shape == (3, ball.n_vertices, 150)
    none = operator.apply(np.empty((ball.n_vertices, 0), np.float32))
    assert none.transfer.shape == (3, ball.n_vertices, 0)


def test_small_blocks_change_nothing(ball, smooth, monkeypatch):
    operator = SubsurfaceOperator(ball, skin(0.3))
    whole = operator.apply(smooth).transfer
    monkeypatch.setattr(subsurface, "VERTICES_PER_CHUNK", 7)
    monkeypatch.setattr(subsurface, "COLUMNS_PER_PRODUCT", 2)
    assert operator.apply(smooth).transfer.tobytes() == whole.tobytes()


def test_one_channel_is_that_of_three(ball, smooth):
    """To what the clusters leave: they are cut at the shortest path and the furthest reach."""
    dipole = skin(0.3)
    three = SubsurfaceOperator(ball, dipole).apply(smooth).transfer
    for channel in range(3):
        part = slice(channel, channel + 1)
        one = Dipole(dipole.scattering[part], dipole.absorption[part], dipole.eta)
        found = SubsurfaceOperator(ball, one).apply(smooth).transfer
        np.testing.assert_allclose(found[0], three[channel], atol=0.01 * total_albedo(one)[0])


def test_seams_change_nothing(ball, smooth):
    """Every triangle with corners of its own: the same surface, the same light."""
    faces = np.arange(3 * ball.n_faces, dtype=np.int32).reshape(-1, 3)
    corner = ball.faces.ravel()
    split = Scene.from_parts([Mesh(ball.positions[corner], faces, ball.normals[corner])])
    for path in (1e-4, 0.05, 0.5):
        joined = SubsurfaceOperator(ball, skin(path)).apply(smooth).transfer
        apart = SubsurfaceOperator(split, skin(path)).apply(smooth[corner]).transfer
        # the same sums in another order
        np.testing.assert_allclose(apart, joined[:, corner], atol=2e-6)


def test_the_report_is_plain_json(ball, smooth):
    report = SubsurfaceOperator(ball, skin(0.3)).apply(smooth).report.to_dict()
    assert report["mean_free_path"][0] == pytest.approx(0.3)
    assert report["extent"] == pytest.approx(skin(0.3).extent().tolist())
    assert report["clusters"] > 0.0
    assert all(isinstance(value, (float, tuple)) for value in report.values())


def test_settings_and_transfer_that_do_not_fit_are_refused(ball, smooth):
    with pytest.raises(SettingsError, match="max_solid_angle"):
        SubsurfaceOperator(ball, skin(1.0), max_solid_angle=-0.1)
    for share in (-0.1, 1.0):
        with pytest.raises(SettingsError, match="dropped_share"):
            SubsurfaceOperator(ball, skin(1.0), dropped_share=share)
    operator = SubsurfaceOperator(ball, skin(1.0))
    with pytest.raises(SettingsError, match="161 vertices"):
        operator.apply(smooth[1:])
    broken = smooth.copy()
    broken[7, 2] = np.nan
    with pytest.raises(SettingsError, match=r"coefficient 2 .* vertex 7"):
        operator.apply(broken)
