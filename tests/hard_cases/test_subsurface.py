"""Subsurface scattering where paths, coefficients or meshes are extreme."""

import numpy as np
import pytest

from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import SubsurfaceOperator


def grey(path, *, lost=0.05, eta=1.3):
    """A medium of a mean free path, of whose meetings a share is absorbed."""
    return Dipole(np.array([(1.0 - lost) / path]), np.array([lost / path]), eta)


def albedo(dipole):
    return dipole.entering_transmittance * dipole.total_reflectance[0]


def ball(subdivisions=3, *, radius=1.0, shift=(0.0, 0.0, 0.0)):
    mesh = sphere_mesh(subdivisions, radius=radius)
    return Mesh(mesh.positions + np.array(shift), mesh.faces, mesh.normals)


def lit(scene):
    return np.stack(
        [np.ones(scene.n_vertices), np.maximum(0.0, scene.normals[:, 1])], axis=1
    ).astype(np.float32)


@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_a_path_of_a_millionth_is_a_plain_surface(lost):
    scene = Scene.from_parts([ball()])
    dipole = grey(1e-6, lost=lost)
    result = SubsurfaceOperator(scene, dipole).apply(lit(scene))
    # the corners of a polyhedron of 642 vertices lack 0.3 % of the full turn
    np.testing.assert_allclose(
        result.transfer[0], albedo(dipole) * lit(scene), atol=5e-3 * albedo(dipole)
    )
    assert result.report.resolution[0] < 1e-4
    assert result.report.clusters < 300


@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_a_path_of_a_million_is_the_mean_times_almost_nothing(lost):
    """R_d is level over the object: R_d(0) times area times mean."""
    scene = Scene.from_parts([ball()])
    dipole = grey(1e6, lost=lost)
    result = SubsurfaceOperator(scene, dipole).apply(lit(scene))
    area = scene.areas.sum()
    mean = scene.areas @ lit(scene) / area
    expected = dipole.entering_transmittance * dipole.profile(np.zeros(1))[0, 0] * area * mean
    # r / path is 1e-6
    np.testing.assert_allclose(
        result.transfer[0], np.tile(expected, (scene.n_vertices, 1)), rtol=1e-5
    )
    assert 0.0 < result.transfer.max() < 1e-10
    assert result.report.clusters == 1.0


def test_zero_scattering_is_black_without_a_walk():
    scene = Scene.from_parts([ball()])
    result = SubsurfaceOperator(scene, grey(0.1, lost=1.0)).apply(lit(scene))
    assert not result.transfer.any()
    assert result.report.clusters == result.report.triangles == 0.0
    assert result.report.albedo == (0.0,)


def test_one_black_channel_leaves_the_others_alone():
    scene = Scene.from_parts([ball()])
    colour = Dipole(np.array([10.0, 0.0, 10.0]), np.array([0.5, 3.0, 0.5]), 1.3)
    found = SubsurfaceOperator(scene, colour).apply(lit(scene)).transfer
    assert not found[1].any()
    np.testing.assert_array_equal(found[0], found[2])
    alone = Dipole(np.array([10.0]), np.array([0.5]), 1.3)
    expected = SubsurfaceOperator(scene, alone).apply(lit(scene)).transfer[0]
    # clusters are cut at the shortest path of all channels
    np.testing.assert_allclose(found[0], expected, atol=5e-3)


def test_zero_absorption_reaches_everywhere_and_loses_nothing_inside():
    scene = Scene.from_parts([ball(4)])
    dipole = grey(0.01, lost=0.0)
    result = SubsurfaceOperator(scene, dipole).apply(lit(scene))
    # what a sphere of radius 1 returns of a dipole in its surface, less than all of it
    assert (result.transfer[0, :, 0] < albedo(dipole)).all()
    assert result.transfer[0, :, 0].min() > 0.9 * albedo(dipole)
    assert result.transfer[0, scene.normals[:, 1] < -0.5, 1].min() > 0.0


def test_one_vertex_has_no_surface():
    mesh = Mesh(np.zeros((1, 3)), np.empty((0, 3), np.int32), np.array([[0.0, 1.0, 0.0]]))
    result = SubsurfaceOperator(Scene.from_parts([mesh]), grey(1.0)).apply(
        np.ones((1, 2), np.float32)
    )
    assert not result.transfer.any()
    assert result.report.resolution == (np.inf,)


def test_one_triangle_is_its_own_source():
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    mesh = Mesh(corners, np.array([[0, 1, 2]], np.int32), np.tile([0.0, 1.0, 0.0], (3, 1)))
    dipole = grey(1e-4)
    result = SubsurfaceOperator(Scene.from_parts([mesh]), dipole).apply(np.eye(3, dtype=np.float32))
    # the share of the full turn at each corner
    np.testing.assert_allclose(
        np.diag(result.transfer[0]), albedo(dipole) * np.array([0.25, 0.125, 0.125]), rtol=2e-3
    )


def test_coincident_vertices_share_their_light():
    """Two sheets in one place, each with vertices of its own, count twice, and evenly."""
    sheet = ball()
    one, two = Scene.from_parts([sheet]), Scene.from_parts([sheet, sheet])
    dipole = grey(0.05)
    single = SubsurfaceOperator(one, dipole).apply(lit(one)).transfer[0]
    double = SubsurfaceOperator(two, dipole).apply(lit(two)).transfer[0]
    assert np.isfinite(double).all()
    # twice the triangles are clustered otherwise, and the cut is further away
    np.testing.assert_allclose(double[: one.n_vertices], 2.0 * single, atol=4e-4 * albedo(dipole))
    np.testing.assert_allclose(double[one.n_vertices :], double[: one.n_vertices], atol=1e-7)


def test_vertices_that_no_triangle_uses_still_receive():
    mesh = ball()
    stray = Mesh(
        np.concatenate([mesh.positions, mesh.positions[:1]]),
        mesh.faces,
        np.concatenate([mesh.normals, mesh.normals[:1]]),
    )
    scene = Scene.from_parts([stray])
    result = SubsurfaceOperator(scene, grey(0.3)).apply(lit(scene)).transfer[0]
    np.testing.assert_allclose(result[-1], result[0], rtol=1e-6)


@pytest.mark.parametrize("distance", [1e3, 1e6])
def test_parts_far_apart_do_not_see_each_other(distance):
    alone = Scene.from_parts([ball()])
    both = Scene.from_parts([ball(), ball(shift=(distance, 0.0, 0.0))])
    dipole = grey(0.2)
    expected = SubsurfaceOperator(alone, dipole).apply(lit(alone)).transfer[0]
    found = SubsurfaceOperator(both, dipole).apply(lit(both)).transfer[0]
    # positions keep 1e-10 of 1e6; clusters are cut elsewhere, and each leaves 1e-4
    np.testing.assert_allclose(found[: alone.n_vertices], expected, atol=2e-3 * albedo(dipole))
    np.testing.assert_allclose(found[alone.n_vertices :], expected, atol=2e-3 * albedo(dipole))


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_unit_of_the_scene_does_not_matter(scale):
    one = Scene.from_parts([ball()])
    other = Scene.from_parts([ball(radius=scale)])
    expected = SubsurfaceOperator(one, Dipole.of_material("marble", mm_per_unit=10.0))
    found = SubsurfaceOperator(other, Dipole.of_material("marble", mm_per_unit=10.0 / scale))
    np.testing.assert_allclose(
        found.apply(lit(other)).transfer, expected.apply(lit(one)).transfer, rtol=1e-5, atol=1e-7
    )
    np.testing.assert_allclose(found.resolution, expected.resolution)
    # negative twin: the same coefficients in a scene of another size
    wrong = SubsurfaceOperator(other, Dipole.of_material("marble", mm_per_unit=10.0))
    difference = wrong.apply(lit(other)).transfer - expected.apply(lit(one)).transfer
    assert np.abs(difference).max() > 0.05


def test_an_inside_out_surface_scatters_the_same():
    """The dipole knows distances alone; which side is lit is the transfer's matter."""
    mesh = ball()
    turned = Mesh(mesh.positions, mesh.faces[:, ::-1].copy(), mesh.normals)
    dipole = grey(0.1)
    one, other = Scene.from_parts([mesh]), Scene.from_parts([turned])
    np.testing.assert_allclose(
        SubsurfaceOperator(other, dipole).apply(lit(one)).transfer,
        SubsurfaceOperator(one, dipole).apply(lit(one)).transfer,
        atol=1e-6,
    )
