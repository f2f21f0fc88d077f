"""Frames between the corners, and paths that start in them."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.brdf.checks import directional_albedo
from prtbake_workers.brdf.ward import Ward
from prtbake_workers.environment.procedural import constant
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.tangents import oriented_frames
from prtbake_workers.transport.path_points import interpolated_frames
from prtbake_workers.transport.path_tracer import PathMaterial, trace_paths
from prtbake_workers.transport.proposal import fit_proposal
from support.bounce_scenes import opaque
from transport.test_path_tracer import seen_points

BRUSHED = Ward(np.array([0.1]), np.array([0.7]), 0.15, 0.5)
AXIS = np.array([0.3, 0.5, 0.8])


def on_a_sphere(n=400):
    mesh = sphere_mesh(4)
    scene = Scene.from_parts([mesh], frames=[oriented_frames(mesh, tuple(AXIS)).frames])
    rng = np.random.default_rng(3)
    triangles = rng.integers(0, scene.n_faces, n)
    barycentrics = rng.dirichlet([1.0, 1.0, 1.0], n)
    normals = np.einsum("pc,pci->pi", barycentrics, scene.normals[scene.faces[triangles]])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return scene, triangles, barycentrics, normals


def off_axis(frames, normals):
    """Sine between tangents and the axis laid into the tangent plane, weighted by its length."""
    along = AXIS / np.linalg.norm(AXIS)
    along = along - (normals @ along)[:, None] * normals
    return np.linalg.norm(np.cross(frames[:, 0], along), axis=1)


def test_frames_between_corners_follow_the_field():
    scene, triangles, barycentrics, normals = on_a_sphere()
    frames = interpolated_frames(scene, triangles, barycentrics, normals)
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (len(frames), 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-12)
    # triangles are 4 degrees wide: their squares, and more at the poles of the field
    assert np.median(off_axis(frames, normals)) < 1e-3
    assert off_axis(frames, normals).max() < 0.03
    # twin: frames of the normals alone
    assert np.median(off_axis(tangent_frames(normals), normals)) > 0.2


def test_opposite_tangents_are_one_line():
    scene, triangles, barycentrics, normals = on_a_sphere()
    flipped = scene.frames.copy()
    flipped[::2, :2] *= -1.0
    turned = replace(scene, frames=flipped)
    frames = interpolated_frames(turned, triangles, barycentrics, normals)
    assert off_axis(frames, normals).max() < 0.03


def test_where_corners_do_not_agree_the_heaviest_decides():
    mesh = grid_mesh(1, 1)
    angle = 2 * np.pi / 3 * np.arange(3)
    frames = tangent_frames(mesh.normals)
    for corner, turn in zip(mesh.faces[0], angle / 2.0, strict=True):
        tangent = np.array([np.cos(turn), 0.0, np.sin(turn)])
        frames[corner, :2] = tangent, np.cross([0.0, 1.0, 0.0], tangent)
    scene = Scene.from_parts([mesh], frames=[frames])
    weights = np.array([[0.5, 0.25, 0.25]])
    found = interpolated_frames(scene, np.zeros(1, np.int64), weights, mesh.normals[:1])
    first = frames[mesh.faces[0, 0], 0]
    assert abs(found[0, 0] @ first) > 0.9
    assert np.linalg.det(found[0]) == pytest.approx(1.0)


@pytest.mark.parametrize("azimuth", [0.0, 0.5, np.pi / 2])
def test_paths_reflect_by_the_frames_of_the_surface(azimuth):
    """Under a white sky a flat surface sends its albedo towards wo, which depends on the azimuth."""
    mesh = grid_mesh(2, 2)
    direction = (np.cos(azimuth), 0.0, -np.sin(azimuth))
    scene = Scene.from_parts([mesh], frames=[oriented_frames(mesh, direction).frames])
    points = seen_points(scene, 8)
    wo = np.tile([0.8, 0.6, 0.0], (len(points), 1))
    points = replace(points, wo=wo, frames=scene.frames[: len(points)])
    found = trace_paths(
        opaque(scene), [PathMaterial(BRUSHED)], points, constant(32), np.eye(3),
        n_bounces=0, n_passes=8, n_samples=256, seed=2,
    )  # fmt: skip
    level = constant(32).radiance[0, 0]
    expected = directional_albedo(BRUSHED, np.array([0.6]), azimuth=-azimuth)[0, 0]
    error = 4.0 * float(np.sqrt(found.variance.mean() / found.variance.size)) + 2e-3
    assert found.mean.mean() / level.mean() == pytest.approx(expected, abs=error)
    other = directional_albedo(BRUSHED, np.array([0.6]), azimuth=np.pi / 2 - azimuth)[0, 0]
    if azimuth != 0.5:
        assert abs(other - expected) > 3.0 * error


def test_the_density_heeds_views_along_and_across():
    """Exchanging the slopes exchanges views of the fit, so the mixture chosen is the same."""
    turned = Ward(BRUSHED.kd, BRUSHED.ks, BRUSHED.alpha_y, BRUSHED.alpha_x)
    assert fit_proposal(BRUSHED) == fit_proposal(turned)
    assert fit_proposal(BRUSHED).lobe_share > 0.0
