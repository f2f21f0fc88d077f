"""Shadow rays of single vertices against an analytic sphere."""

import numpy as np

from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.visibility import padded_directions, visible_fraction

CUBE = cube_directions(10)
BALL = sphere_mesh(5)  # radius 1 on y = 0
CENTRE = np.array([0.0, 1.0, 0.0])
ORIGINS = np.array([[0.0, -1.0, 0.0], [2.5, 0.2, 0.3], [0.0, 1.0, 0.0]], np.float32)
NORMALS = np.array([[0.0, 1.0, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], np.float32)


def hits_ball(origin, directions, radius=1.0):
    towards = CENTRE - origin
    along = directions @ towards
    return (along > 0) & (along**2 > towards @ towards - radius**2)


def traced(samples):
    accelerator = Accelerator(BALL.positions, BALL.faces)
    cosines = NORMALS @ CUBE.directions.T.astype(np.float32)
    out = np.full(cosines.shape, 7.0, np.float32)
    n_rays = visible_fraction(
        accelerator, ORIGINS, NORMALS, cosines, padded_directions(samples), out
    )
    return cosines, out, n_rays


def test_visible_share_equals_the_analytic_count():
    samples = CUBE.sub_directions(3)
    cosines, out, n_rays = traced(samples)
    above = cosines > 0
    assert n_rays == 9 * above.sum()
    assert not out[~above].any()
    expected, wrong = np.zeros_like(out), np.zeros_like(out)
    for v in range(2):
        risen = samples @ NORMALS[v] > 0
        for got, radius in ((expected, 1.0), (wrong, 0.97)):
            free = risen & ~hits_ball(ORIGINS[v].astype(np.float64), samples, radius)
            got[v] = np.where(above[v], free.sum(0) / np.maximum(risen.sum(0), 1), 0)
    # rays that pass between the polyhedron and its sphere: a sample or two in 100 texels
    assert np.abs(out[:2] - expected[:2]).mean() < 2e-4
    assert np.abs(out[:2] - wrong[:2]).mean() > 2e-3
    # from the centre of the ball nothing is seen, rays through the mesh's edges aside
    assert out[2].mean() < 2e-3


def test_one_sample_gives_zero_or_one():
    cosines, out, n_rays = traced(CUBE.sub_directions(1))
    assert n_rays == (cosines > 0).sum()
    assert set(np.unique(out)) == {0.0, 1.0}


def test_rays_from_one_point_are_rays(rng):
    accelerator = Accelerator(BALL.positions, BALL.faces)
    directions = rng.normal(size=(5000, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = ORIGINS[1]
    rows = np.repeat(origin[None], len(directions), axis=0)
    expected = accelerator.occluded(rows, directions)
    np.testing.assert_array_equal(accelerator.occluded_from(origin, directions), expected)
    assert 0 < expected.sum() < len(expected)
    elsewhere = accelerator.occluded_from(ORIGINS[0], directions)
    assert (elsewhere != expected).any()
