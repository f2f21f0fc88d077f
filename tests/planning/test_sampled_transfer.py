"""Samples of a few vertices against the plain twin of the bake."""

import numpy as np
import pytest

from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.planning.sampled_transfer import (
    MIXTURES,
    ProbeDirections,
    SampledTransfer,
)
from prtbake_workers.transport.directions import cube_directions
from support.dense_twin import sampled_transport

SCENE = Scene.from_parts([teapot(4)])
ACCELERATOR = Accelerator(SCENE.positions, SCENE.faces)
GLOSSY = CookTorrance(np.array([0.3]), np.array([0.7]), 0.3, np.array([0.1]))
ONE, FEW, MANY = (factorise(GLOSSY, n_terms=count) for count in (1, 3, 16))
RESOLUTION = 10


def vertices_of(probed):
    """The vertices that were drawn, found again by where their rays start."""
    origins = offset_origins(SCENE.ray_points, SCENE.ray_sides, ray_epsilon(SCENE.bounds))
    same = (probed.origins[:, None] == origins).all(axis=2)
    assert (same.sum(axis=1) == 1).all()
    return same.argmax(axis=1)


def probed_with(factorisation, accelerator, count=64):
    return SampledTransfer.of(
        SCENE, 0, factorisation, accelerator, count=count, rng=np.random.default_rng(2)
    )


@pytest.mark.parametrize("supersample", [1, 2])
@pytest.mark.parametrize("shadows", [True, False])
def test_few_terms_are_sampled_as_the_bake_would(shadows, supersample):
    accelerator = ACCELERATOR if shadows else None
    probed = probed_with(FEW, accelerator)
    found = probed.sample(ProbeDirections.of_cube(RESOLUTION, supersample))
    cube = cube_directions(RESOLUTION)
    found = found.reshape(probed.n_vertices, 3, cube.n) / np.sqrt(cube.weights)
    assert probed.n_functions == 3 * probed.n_vertices
    expected = np.stack(
        [
            sampled_transport(
                SCENE, accelerator, one, factorisation=FEW, directions=cube, supersample=supersample
            )
            for one in vertices_of(probed)
        ]
    )
    # float32 tables and frames; a ray in a thousand may pass an edge on the other side
    off = np.abs(found - expected) > 2e-4 * np.abs(expected).max(axis=(1, 2), keepdims=True)
    assert off.mean() < 1e-3
    # negative twin: without shadows it is other light
    if shadows:
        bare = probed_with(FEW, None).sample(ProbeDirections.of_cube(RESOLUTION, supersample))
        lit = (bare.astype(np.float64) ** 2).sum()
        assert lit > 1.05 * (found**2 * cube.weights).sum()


def test_random_sums_of_many_terms_have_their_energy():
    probed = probed_with(MANY, ACCELERATOR, count=128)
    at = ProbeDirections.of_cube(RESOLUTION, 1)
    found = probed.sample(at).astype(np.float64)
    assert len(found) == probed.n_functions == MIXTURES * probed.n_vertices
    cube = cube_directions(RESOLUTION)
    expected = 0.0
    for vertex in vertices_of(probed):
        samples = sampled_transport(SCENE, ACCELERATOR, vertex, factorisation=MANY, directions=cube)
        expected += (samples**2 @ cube.weights).sum()
    # 512 sums of which each has a standard deviation of about its mean: 6 % at most
    assert (found**2).sum() == pytest.approx(expected, rel=0.1)
    # negative twin: the first term alone has less
    first = (probed_with(ONE, ACCELERATOR, count=128).sample(at).astype(np.float64) ** 2).sum()
    assert first < 0.9 * expected


def test_directions_that_are_held_out_are_no_bakes():
    at = ProbeDirections.held_out(RESOLUTION, np.random.default_rng(0))
    own = cube_directions(RESOLUTION)
    assert np.abs(np.linalg.norm(at.directions, axis=1) - 1.0).max() < 1e-12
    assert (at.root_weights**2).sum() == pytest.approx(4.0 * np.pi)
    nearest = (at.directions @ own.directions.T).max(axis=1)
    assert np.median(np.arccos(np.minimum(nearest, 1.0))) > 0.02
    np.testing.assert_array_equal(at.rays[0], at.directions.astype(np.float32))


def test_vertices_without_a_normal_are_left():
    mesh = teapot(4)
    normals = mesh.normals.copy()
    normals[: mesh.n_vertices // 2] = 0.0
    scene = Scene.from_parts([Mesh(mesh.positions, mesh.faces, normals)])
    probed = SampledTransfer.of(scene, 0, FEW, None, count=200, rng=np.random.default_rng(0))
    assert 20 < probed.n_vertices < 180
    assert np.isfinite(probed.sample(ProbeDirections.of_cube(4, 1))).all()


def test_no_vertex_gives_no_function():
    probed = probed_with(MANY, ACCELERATOR, count=0)
    assert probed.n_functions == 0
    assert probed.sample(ProbeDirections.of_cube(4, 1)).shape == (0, 96)
