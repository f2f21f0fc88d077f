"""Tangents along texture coordinates and directions, against parametrisations known in closed form."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.tangents import oriented_frames


def cylinder(skew=0.0, around=48, along=6):
    """Axis y, u around it and v = height - skew * angle: dP/du runs round, and climbs by the skew.

    The first and the last column of vertices share positions and normals and differ in u: a seam.
    """
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, around + 1), np.linspace(0, 1, along + 1))
    angle, height = angle.ravel(), height.ravel()
    normals = np.stack([np.sin(angle), np.zeros(angle.size), np.cos(angle)], axis=1)
    corner = (np.arange(along)[:, None] * (around + 1) + np.arange(around)).ravel()
    above = corner + around + 1
    faces = np.concatenate(
        [np.stack([corner, corner + 1, above], 1), np.stack([corner + 1, above + 1, above], 1)]
    ).astype(np.int32)
    uv = np.stack([angle / (2 * np.pi), height - skew * angle], axis=1)
    return Mesh(normals + height[:, None] * [0.0, 1.0, 0.0], faces, normals, uv), angle


def off_line(found, expected):
    """Sine of the angle between tangents and lines; a line has no sense."""
    expected = expected / np.linalg.norm(expected, axis=1, keepdims=True)
    return np.linalg.norm(np.cross(found, expected), axis=1)


@pytest.mark.parametrize("skew", [0.0, 0.5, -2.0])
def test_tangents_of_a_cylinder_are_those_of_its_parametrisation(skew):
    mesh, angle = cylinder(skew)
    found = oriented_frames(mesh, "uv")
    assert len(found.singular) == 0
    # along u at fixed v the height grows by skew * angle
    expected = np.stack([np.cos(angle), np.full(angle.size, skew), -np.sin(angle)], axis=1)
    # facets of 7.5 degrees: their chords stand for arcs within 0.001, ends see one side only
    assert off_line(found.frames[:, 0], expected).max() < 3e-3
    # the sense too, since all triangles agree on one
    assert (found.frames[:, 0] * expected).sum(axis=1).min() > 0.0
    # twin: v in place of u
    swapped = Mesh(mesh.positions, mesh.faces, mesh.normals, mesh.uv[:, ::-1].copy())
    wrong = oriented_frames(swapped, "uv").frames[:, 0]
    assert off_line(wrong, expected).min() > 0.4


@pytest.mark.parametrize("tangents", ["horizontal", "uv", (0.3, 1.0, -0.2)])
def test_frames_are_right_handed_rotations_onto_the_normal(tangents):
    mesh, _ = cylinder(0.7)
    frames = oriented_frames(mesh, tangents).frames
    # float64 rounding
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (len(frames), 1, 1)), atol=1e-14
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-14)
    np.testing.assert_array_equal(frames[:, 2], mesh.normals)


def test_a_mirrored_chart_has_the_same_lines_and_right_handed_frames():
    mesh = grid_mesh(4, 4)
    plain = oriented_frames(mesh, "uv").frames
    for mirror in ([-1.0, 1.0], [1.0, -1.0]):
        mirrored = Mesh(mesh.positions, mesh.faces, mesh.normals, mesh.uv * mirror)
        found = oriented_frames(mirrored, "uv")
        assert len(found.singular) == 0
        assert off_line(found.frames[:, 0], plain[:, 0]).max() < 1e-12
        np.testing.assert_allclose(np.linalg.det(found.frames), 1.0, atol=1e-14)
        # u backwards turns the tangent over; v backwards does not
        np.testing.assert_allclose((found.frames[:, 0] * plain[:, 0]).sum(axis=1), mirror[0])


def test_halves_mirrored_about_a_shared_column_agree_on_its_line():
    """Vertices of the mirror line see dP/du from both sides: opposite vectors, one line."""
    mesh = grid_mesh(4, 4)
    uv = np.stack([np.abs(mesh.positions[:, 0]), mesh.uv[:, 1]], axis=1)
    found = oriented_frames(Mesh(mesh.positions, mesh.faces, mesh.normals, uv), "uv")
    assert len(found.singular) == 0
    assert off_line(found.frames[:, 0], np.tile([1.0, 0.0, 0.0], (25, 1))).max() < 1e-12


def test_seams_have_frames_of_their_own():
    """Two squares side by side, their charts turned against each other by 90 degrees."""
    left = grid_mesh(1, 1)
    uv = np.concatenate([left.uv, np.stack([left.uv[:, 1], -left.uv[:, 0]], axis=1)])
    mesh = Mesh(
        np.concatenate([left.positions, left.positions + np.eye(3)[0]]),
        np.concatenate([left.faces, left.faces + 4]).astype(np.int32),
        np.tile([0.0, 1.0, 0.0], (8, 1)),
        uv,
    )
    tangents = oriented_frames(mesh, "uv").frames[:, 0]
    assert off_line(tangents[:4], np.tile([1.0, 0.0, 0.0], (4, 1))).max() < 1e-12
    assert off_line(tangents[4:], np.tile([0.0, 0.0, 1.0], (4, 1))).max() < 1e-12


def test_larger_triangles_count_for_more():
    """A vertex between two triangles whose lines stand at 0 and 40 degrees, areas 3 to 1."""
    turn = np.deg2rad(40.0)
    positions = np.array([[0, 0, 0], [0, 3, 0], [-2, 0, 0], [1.0, 0, 0], [0.5, 4 / 3, 0]])
    normals = np.tile([0.0, 0.0, 1.0], (5, 1))
    faces = np.array([[0, 1, 2], [0, 3, 4]], np.int32)
    uv = positions[:, :2].copy()
    c, s = np.cos(turn), np.sin(turn)
    uv[3:] = positions[3:, :2] @ np.array([[c, -s], [s, c]])
    areas = np.array([3.0, 2.0 / 3.0])
    found = oriented_frames(Mesh(positions, faces, normals, uv), "uv").frames[0, 0]
    expected = 0.5 * np.angle(areas @ np.exp(2j * np.array([0.0, turn])))
    assert np.arctan2(found[1], found[0]) == pytest.approx(expected, abs=1e-12)
    assert abs(expected - turn / 2) > 0.1


@pytest.mark.parametrize("axis", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -3.0)])
def test_a_sphere_brushed_along_an_axis_has_two_singular_poles(axis):
    mesh = sphere_mesh(4)
    found = oriented_frames(mesh, axis)
    axis = np.array(axis) / np.linalg.norm(axis)
    poles = np.flatnonzero(np.abs(mesh.normals @ axis) > 1.0 - 1e-9)
    np.testing.assert_array_equal(found.singular, poles)
    assert len(poles) == 2
    # meridians elsewhere: in the plane of normal and axis, towards the axis
    away = np.setdiff1d(np.arange(mesh.n_vertices), poles)
    tangents = found.frames[away, 0]
    expected = axis - (mesh.normals[away] @ axis)[:, None] * mesh.normals[away]
    assert off_line(tangents, expected).max() < 1e-9
    assert (tangents @ axis).min() > 0.0
    np.testing.assert_array_equal(found.frames[poles], tangent_frames(mesh.normals[poles]))


def test_an_oblique_axis_meets_no_vertex():
    assert len(oriented_frames(sphere_mesh(3), (0.3, 0.5, 0.7)).singular) == 0


def test_horizontal_tangents_are_the_default_frames_and_their_poles_are_told():
    mesh = sphere_mesh(2)
    found = oriented_frames(mesh, "horizontal")
    np.testing.assert_array_equal(found.frames, tangent_frames(mesh.normals))
    assert sorted(mesh.normals[found.singular, 1].tolist()) == [-1.0, 1.0]


def test_degenerate_texture_triangles_are_singular_and_horizontal():
    mesh = grid_mesh(3, 3)
    uv = mesh.uv.copy()
    uv[:, 1] = 0.0
    uv[mesh.positions[:, 0] > 0.0, 0] = 0.25
    found = oriented_frames(Mesh(mesh.positions, mesh.faces, mesh.normals, uv), "uv")
    assert len(found.singular) == mesh.n_vertices
    np.testing.assert_array_equal(found.frames, tangent_frames(mesh.normals))


def test_lines_that_cancel_are_singular():
    """A fan about a vertex with u by the radius: its lines point everywhere."""
    angle = 2 * np.pi * np.arange(8) / 8
    rim = np.stack([np.cos(angle), np.zeros(8), np.sin(angle)], axis=1)
    positions = np.concatenate([[[0.0, 0.0, 0.0]], rim])
    faces = np.stack([np.zeros(8, int), 1 + (np.arange(8) + 1) % 8, 1 + np.arange(8)], axis=1)
    # each spoke has its own v, and the fan closes between the last and the first
    uv = np.concatenate([[[0.0, 0.5]], np.stack([np.ones(8), np.tile([0.0, 1.0], 4)], axis=1)])
    mesh = Mesh(positions, faces.astype(np.int32), np.tile([0.0, 1.0, 0.0], (9, 1)), uv)
    assert oriented_frames(mesh, "uv").singular.tolist() == [0]
    # twin: without a quarter of the fan a line is left
    part = Mesh(positions, mesh.faces[:6], mesh.normals, uv)
    assert 0 not in oriented_frames(part, "uv").singular


def test_impossible_tangents_are_told():
    for tangents, what in (("uv", "texture coordinates"), ((0.0, 0.0, 0.0), "length")):
        with pytest.raises(SettingsError, match=what):
            oriented_frames(sphere_mesh(1), tangents)
