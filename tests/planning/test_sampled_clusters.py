"""Vertices and transfer of a few clusters against the whole part's, as the bake has it."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.planning.sampled_clusters import (
    FEWEST_VERTS,
    MOST_CLUSTERS,
    MOST_VALUES,
    MOST_VERTS,
    VERTS_PER_RANK,
    SampledDirections,
    _along_a_curve,
    draw_clusters,
    sampled_coefficients,
)
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from support.bounce_scenes import ball

BALL = Scene.from_parts([ball(4)])
POT = Scene.from_parts([teapot(4), ball(1)])
BASIS = SrbfBasis(icosphere(1))
GLOSSY = factorise(CookTorrance(np.array([0.3]), np.array([0.7]), 0.5, np.array([0.1])), n_terms=3)


def drawn(scene, part, n_clusters, n_values=100, rank=8):
    rng = np.random.default_rng(5)
    return draw_clusters(scene, part, n_clusters, rank=rank, n_values=n_values, rng=rng)


def test_clusters_lie_together():
    verts, count = drawn(BALL, 0, 64)
    assert count == MOST_CLUSTERS
    assert len(set(verts)) == len(verts) <= MOST_CLUSTERS * len(BALL.positions) // 64
    # a 64th of the sphere lies within 14.4 degrees of its middle: two of its places within 29, as
    # 6 % of all do; a 16th of the pairs are of one cluster
    cosine = np.cos(np.radians(29.0))
    places = BALL.positions[verts]
    assert (places @ places.T > cosine).mean() > 0.09
    # negative twin: as many vertices from all over
    rng = np.random.default_rng(1)
    scattered = BALL.positions[rng.choice(len(BALL.positions), len(verts), replace=False)]
    assert (scattered @ scattered.T > cosine).mean() < 0.08
    # clusters are spread evenly: no octant has less than half of its share
    octants = np.bincount((places > 0.0) @ [1, 2, 4], minlength=8)
    assert octants.min() > len(verts) / 16


@pytest.mark.parametrize("n_clusters", [1, 5, MOST_CLUSTERS])
def test_few_clusters_are_drawn_from_all_over(n_clusters):
    verts, count = drawn(POT, 1, n_clusters)
    start, stop = POT.part_ranges[1]
    assert count == n_clusters
    assert list(verts) == list(range(start, stop))


def test_clusters_whose_middles_coincide_are_one():
    """Twelve places with a twelfth of the vertices each: sixteen middles are twelve."""
    n_verts = len(BALL.positions)
    twelve = icosphere(0)[np.arange(n_verts) * 12 // n_verts]
    verts, count = drawn(replace(BALL, positions=twelve, normals=twelve), 0, 24)
    assert count == 12
    assert len(np.unique(twelve[verts], axis=0)) == 12
    # negative twin: where vertices have places of their own, clusters overlap little
    assert drawn(BALL, 0, 24)[1] > 12


def test_large_vertices_are_drawn_no_more_often():
    """Compression weighs them by their area already."""
    areas = BALL.areas.copy()
    areas[7] = areas.sum()
    large = replace(BALL, areas=areas)
    assert list(drawn(large, 0, 64)[0]) == list(drawn(BALL, 0, 64)[0])


def test_few_vertices_are_spread_evenly():
    """Each sixteenth along the curve has its share, which chance does not give."""
    own = np.argsort(_along_a_curve(BALL.positions), kind="stable")
    rank = np.argsort(own, kind="stable")
    verts, _ = drawn(BALL, 0, 2, n_values=MOST_VALUES // 256)
    assert len(verts) == 256
    shares = np.histogram(rank[verts], bins=16, range=(0, len(own)))[0]
    assert 15 <= shares.min() <= shares.max() <= 17
    chance = np.random.default_rng(2).choice(len(own), 256, replace=False)
    assert np.ptp(np.histogram(chance, bins=16, range=(0, len(own)))[0]) > 4


def test_many_values_leave_fewer_vertices():
    few, count = drawn(BALL, 0, 20, n_values=MOST_VALUES // 300)
    assert count == 300 // FEWEST_VERTS
    assert len(few) <= 300
    assert len(drawn(BALL, 0, 1)[0]) == MOST_VERTS


@pytest.mark.parametrize("rank", [1, 12, 20, 50, 100])
def test_clusters_have_vertices_for_their_rank(rank):
    verts, count = drawn(BALL, 0, 6, rank=rank)
    # a sixth of 2562 vertices, of which clusters overlap little
    each = max(FEWEST_VERTS, VERTS_PER_RANK * rank)
    most = min(6, MOST_VERTS // each)
    assert max(2, 0.7 * most) <= count <= most
    assert 0.8 * each * most <= len(verts) <= MOST_VERTS


def test_a_rank_that_the_limits_do_not_hold_is_not_tried():
    rank = MOST_VERTS // (2 * VERTS_PER_RANK) + 1
    assert drawn(BALL, 0, 3, rank=rank)[1] == 0
    assert drawn(BALL, 0, 3, rank=rank - 1)[1] == 2
    # one cluster is the whole part; a cluster of few vertices is looked at whole
    assert drawn(BALL, 0, 1, rank=rank)[1] == 1
    assert drawn(BALL, 0, 100, rank=rank)[1] == MOST_CLUSTERS


def test_transfer_is_that_of_a_bake_in_these_directions():
    accelerator = Accelerator(POT.positions, POT.faces)
    directions = SampledDirections.of(BASIS, 32)
    cube = cube_directions(8)
    assert directions.at.n == cube.n  # 384 directions for 42 functions, the coarsest that does
    verts, _ = drawn(POT, 0, 1)
    found = sampled_coefficients(POT, verts, GLOSSY, accelerator, directions)
    baked = bake_block(
        POT,
        accelerator,
        POT.part_ranges[0],
        factorisation=GLOSSY,
        projection=BASIS.projection(cube.directions, cube.weights),
        directions=cube,
    ).coefficients[verts]
    # float32 sums; a ray in a thousand may pass an edge on the other side
    off = np.abs(found - baked) > 1e-4 * np.abs(baked).max(axis=(1, 2), keepdims=True)
    assert off.mean() < 0.01
    # negative twin: nothing blocks the light
    bare = sampled_coefficients(POT, verts, GLOSSY, None, directions)
    assert np.square(bare - baked).sum() > 1e-3 * np.square(baked).sum()


def test_directions_are_no_finer_than_the_bake_s():
    assert SampledDirections.of(BASIS, 5).at.n == 6 * 25
