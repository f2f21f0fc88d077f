"""Paths through parts that scatter light, against the operator with every triangle integrated."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.environment.procedural import constant, one_texel_sun
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.dipole_sampling import DipoleSampler
from prtbake_workers.transport.part_scattering import PartScattering
from prtbake_workers.transport.path_material import PathMaterial
from prtbake_workers.transport.path_points import PathPoints
from prtbake_workers.transport.path_tracer import trace_paths
from prtbake_workers.transport.subsurface import SubsurfaceOperator
from support.bounce_scenes import ball, bowl, opaque

ONE = Lambert(np.array([1.0]))
MEDIUM = Dipole(np.array([6.0, 5.0, 9.0]), np.array([0.1, 0.9, 2.0]), 1.4)
TINT = np.array([0.9, 0.6, 0.3])


def tinted(triangles, _):
    return np.tile(TINT, (len(triangles), 1))


def scattering(scene, dipole=MEDIUM, **options):
    return PathMaterial(ONE, scattering=DipoleSampler(scene, 0, dipole), **options)


def trace(scene, materials, points, light, **options):
    options = {"n_bounces": 0, "n_passes": 8, "n_samples": 512, "seed": 1} | options
    return trace_paths(opaque(scene), materials, points, light, np.eye(3), **options)


def vertices_of(scene, chosen):
    return PathPoints.of_vertices(scene, chosen, scene.normals[chosen])


def exact(scene, dipole, values, rows):
    """S with every triangle integrated, times values of the vertices, (rows, channels)."""
    operator = SubsurfaceOperator(scene, dipole, max_solid_angle=0.0, dropped_share=0.0)
    sources = operator.sources(values.astype(np.float32)[:, None])
    return np.stack([(m @ sources)[:, 0] for m in operator.block(rows).matrices], axis=1)


@pytest.mark.parametrize("path", [0.05, 0.3, 4.0])
def test_even_light_on_a_ball(path):
    """Every point receives pi: what leaves is S 1, whatever the way."""
    scene = Scene.from_parts([ball(2)])
    dipole = Dipole(MEDIUM.scattering / path, MEDIUM.absorption / path, MEDIUM.eta)
    rows = np.array([0, 5, 40, 100])
    expected = exact(scene, dipole, np.ones(scene.n_vertices), rows) * TINT
    parts = [scattering(scene, dipole, texture=tinted)]
    found = trace(scene, parts, vertices_of(scene, rows), constant(16))
    error = np.sqrt(found.variance)
    # smooth normals of a coarse ball send some rays into its facets
    assert (np.abs(found.mean - expected) < 5.0 * error + 0.01 * expected).all()
    # negative twins: no tint, and light that leaves where it falls
    assert (np.abs(found.mean / TINT - expected) > 5.0 * error + 0.01 * expected)[:, 2].all()
    there = trace(scene, [PathMaterial(Lambert(TINT))], vertices_of(scene, rows), constant(16))
    assert (np.abs(there.mean - expected) > 0.02).any()


def test_a_sun_on_a_ball():
    """One lobe: T is a clamped cosine, which the operator gets at the vertices of a fine ball."""
    scene, light = Scene.from_parts([ball(3)]), one_texel_sun(32)
    lit = trace(scene, [PathMaterial(ONE)], vertices_of(scene, np.arange(scene.n_vertices)), light,
                n_samples=16).mean[:, 0]  # fmt: skip
    rows = np.array([np.argmax(lit), np.argmin(lit), 100, 333])
    expected = exact(scene, MEDIUM, lit, rows)
    found = trace(scene, [scattering(scene)], vertices_of(scene, rows), light, n_samples=2048)
    error = np.sqrt(found.variance)
    largest = expected.max()
    assert (np.abs(found.mean - expected) < 5.0 * error + 0.01 * largest).all()
    # light comes through to where none falls
    assert (found.mean[1] - MEDIUM.diffuse_albedo * lit[rows[1]] > 5.0 * error[1]).all()
    # a sample is worth something: the sun is found from where the light entered
    assert (error < 0.03 * largest).all()


def test_bounces_between_a_ball_that_scatters_and_a_bowl():
    """As the bake sums them: (1 - S G) T_out = S T, through both of its parts."""
    scene = Scene.from_parts([ball(2, centre=(0.0, -0.6, 0.0), radius=0.3), bowl(10, 20)])
    surface, everything = opaque(scene), np.arange(scene.n_vertices)
    plain = trace(scene, [PathMaterial(ONE)] * 2, vertices_of(scene, everything), constant(16),
                  n_passes=2, n_samples=256)  # fmt: skip
    (split, _), n = scene.part_ranges[1], scene.n_vertices
    direct = plain.mean[:, :1, None].astype(np.float32)
    block = bounce_block(
        surface, [direct[:split], direct[split:]], factorisations=[factorise(ONE)] * 2,
        albedo=Albedo.of_parts(scene, [TINT, np.full(3, 0.7)], [None, None]), n_channels=3,
        n_rays=[256] * 2, seed=3, max_bounces=12, tolerance=0.0,
        scattering=[PartScattering(scene.part(0), MEDIUM), None],
    )  # fmt: skip
    expected = np.concatenate([block.added[0], block.added[1] + direct[split:, None]])[:, :, 0, 0]
    expected[:split] *= TINT
    expected[split:] *= 0.7
    rows = np.array([3, 50, 120, split + 30, split + 100, n - 30])
    parts = [scattering(scene, texture=tinted), PathMaterial(Lambert(np.array([0.7])))]
    points = vertices_of(scene, rows)
    found = trace(scene, parts, points, constant(16), n_bounces=12, n_samples=256)
    # interpolation between the vertices of a coarse bowl
    np.testing.assert_allclose(found.mean, expected[rows], rtol=0.05)
    # negative twin: the bounced light that the ball sends leaves where it fell
    there = replace(parts[0], brdf=Lambert(MEDIUM.diffuse_albedo), scattering=None)
    other = trace(scene, [there, parts[1]], points, constant(16), n_bounces=12, n_passes=2)
    assert np.abs(other.mean / expected[rows] - 1.0).max() > 0.1


def test_parts_that_scatter_leave_the_paths_of_others_as_they_are():
    """Number by number: a scene without a medium is traced as if there were none to be had."""
    scene = Scene.from_parts([ball(1), bowl(4, 8)])
    points = vertices_of(scene, np.arange(scene.part_ranges[1][0], scene.n_vertices))
    materials = [PathMaterial(Lambert(np.array([0.0]))), PathMaterial(ONE)]
    black = Dipole(np.array([0.0]), np.array([1.0]), 1.3)
    one, other = (
        trace(scene, [first, materials[1]], points, constant(16), n_bounces=1, n_samples=16)
        for first in (materials[0], scattering(scene, black))
    )
    np.testing.assert_allclose(one.passes, other.passes, rtol=1e-12)
