"""Bytes that a few clusters tell, against a whole part that is baked, compressed and written."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.compress.methods import Fit, compress
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.geometry.teapot import teapot
from prtbake_workers.planning import trial_compression
from prtbake_workers.planning.cost import part_cost
from prtbake_workers.planning.file_bytes import NumberBytes
from prtbake_workers.planning.packed_factors import WholePart, factor_bytes
from prtbake_workers.planning.planned import BouncePlan, PartPlan, Plan
from prtbake_workers.planning.presets import PartCompression, PlannedBake
from prtbake_workers.planning.sampled_clusters import (
    SampledDirections,
    draw_clusters,
    sampled_coefficients,
)
from prtbake_workers.planning.trial_compression import (
    COLOURED_LESS,
    SCATTERED_MORE,
    try_parts,
)
from prtbake_workers.planning.trial_work import TrialSize
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from support.bounce_scenes import ball
from support.part_file import factor_bytes_in_file

SHARE, RESOLUTION = 0.01, 8
BASIS = SrbfBasis(icosphere(1))
SIZES = PlannedBake(cube_resolution=RESOLUTION, n_centres=42)
MATT = factorise(Lambert(np.array([0.7])))
POT = Scene.from_parts([teapot(6)])
BLOCKED = Accelerator(POT.positions, POT.faces)
FEW = PartCompression("cpca", 4, (1, 1, 1), 8)
MANY = PartCompression("cpca", 30, (1, 1, 1), 6)
LONE = PartCompression("cpca", 1, (1, 1, 1), 16)
TENSOR = PartCompression("cta", 4, (4, 32, 16), 6)
SIZE = TrialSize(
    n_verts=800,
    n_terms=1,
    n_coeffs=BASIS.n,
    n_channels=1,
    n_dirs=384,
    whole_verts=10_000,
    compression=FEW,
    rays=True,
)


def planned(scene, compression, bounces=None):
    """As much of a plan as trials read."""
    parts = tuple(
        PartPlan(
            name="part",
            role="object",
            vertex_range=(start, stop),
            n_terms=1,
            lobe="none",
            occluders=(),
            compression=compression,
            tiles=((start, stop),),
            cost=part_cost(SIZES, compression, n_verts=stop - start, n_terms=1),
        )
        for start, stop in scene.part_ranges
    )
    return Plan(parts, (), bounces, {}, (), {}, {}, ())


def tried(compression=FEW, *, scene=POT, blocked=BLOCKED, brdf=MATT, bounces=None, **changes):
    plan = planned(scene, compression, bounces)
    given = {"cube_resolution": RESOLUTION, "share": SHARE, "seed": 3} | changes
    n_parts = len(scene.part_ranges)
    return try_parts(scene, [blocked] * n_parts, [brdf] * n_parts, plan, BASIS, **given)


def factors(*args, **changes):
    (found,) = tried(*args, **changes).number_bytes
    return found.factors


@pytest.fixture(scope="module")
def baked():
    cube = cube_directions(RESOLUTION)
    return bake_block(
        POT,
        BLOCKED,
        POT.part_ranges[0],
        factorisation=MATT,
        projection=BASIS.projection(cube.directions, cube.weights),
        directions=cube,
    ).coefficients


@pytest.mark.parametrize("compression", [FEW, MANY], ids=["fewer", "more"])
def test_few_clusters_tell_the_bytes_of_a_part_that_was_baked_whole(compression, baked, tmp_path):
    fit = Fit(seed=0, max_iterations=8, vertex_weights=POT.areas)
    done = compress(compression.method, baked, compression, fit)
    expected = factor_bytes_in_file(done, POT.areas, SHARE, BASIS.stored, tmp_path / "file.h5")
    # what the cost model asks for
    assert factors(compression) == pytest.approx(expected, rel=0.15)
    # negative twin: where nothing blocks the light much less is left
    bare = factors(compression, blocked=None)
    assert abs(bare / expected - 1.0) > 0.15


def test_components_decide_the_bytes():
    one, forty = (factors(replace(FEW, n_components=number)) for number in (1, 40))
    assert abs(np.log(forty / one)) > np.log(1.15)


def test_ranks_that_few_vertices_do_not_tell_are_left_to_the_mean_share():
    trial = tried(replace(FEW, n_clusters=2, n_components=101))
    assert trial.number_bytes == (None,)
    assert trial.work["trial_rays"] == 0.0


def test_dark_parts_are_told_from_what_was_not_tried():
    """A ball within a ball: no light reaches it."""
    scene = Scene.from_parts([ball(3, radius=0.5), ball(3)])
    blocked = Accelerator(scene.positions, scene.faces)
    inner, outer = tried(scene=scene, blocked=blocked).number_bytes
    assert inner.factors < 0.02
    assert outer.factors > 0.3
    # black is what a surface gives back, not what falls on it: the file holds as much of it
    black = factorise(Lambert(np.zeros(1)))
    assert factors(brdf=black) == factors()
    # no normal can be used: nothing is baked
    bare = replace(POT, normals=np.zeros_like(POT.normals))
    assert factors(scene=bare) < 0.02


def bounced(*, n_channels=1, coloured=False, scattering=()):
    return BouncePlan(
        n_channels=n_channels,
        coloured=coloured,
        n_rays=(8,),
        later_rays=(8,),
        noise_tolerance=1e-3,
        max_bounces=1,
        tolerance=1e-3,
        scattering=scattering,
        solid_angles=(),
        blocks=((0, BASIS.n),),
    )


def test_light_that_is_not_followed_has_shares_of_its_own():
    plain = factors()
    assert factors(bounces=bounced()) == plain
    coloured = factors(bounces=bounced(n_channels=3, coloured=True))
    assert coloured == pytest.approx(COLOURED_LESS * plain)
    scattered = factors(bounces=bounced(n_channels=3, scattering=(0,)))
    assert scattered == pytest.approx(SCATTERED_MORE * plain)
    # 16 bits are the most
    most = trial_compression._scaled(NumberBytes(1.9, 0.0), SCATTERED_MORE)
    assert most.factors == 2.0


def test_an_error_counts_in_place_of_the_share():
    coarse, fine = (factors(max_error=error) for error in (1e-4, 1e-6))
    # a hundredth of the error is log2(10) bits more
    assert fine - coarse == pytest.approx(np.log2(10.0) / 8.0, rel=0.3)
    assert factors(max_error=1e-4, share=0.5) == coarse


def test_the_seed_decides_alone():
    assert tried(MANY) == tried(MANY)
    assert tried(MANY, seed=4).number_bytes != tried(MANY).number_bytes


def test_rays_are_counted_where_something_may_block():
    free, blocked = tried(blocked=None), tried()
    assert free.work["trial_rays"] == 0.0
    assert blocked.work["trial_rays"] == 800 * 3 * RESOLUTION**2
    assert blocked.work["trial_flops"] == free.work["trial_flops"] > 0.0


def test_more_to_look_at_is_more_work():
    before = SIZE.work["trial_flops"]
    for changes in (
        {"n_terms": 2},
        {"n_coeffs": 2 * BASIS.n},
        {"n_channels": 3},
        {"n_dirs": 768},
        {"texels": 1000},
        {"compression": replace(FEW, n_components=16)},
    ):
        assert replace(SIZE, **changes).work["trial_flops"] > before, changes
    # twice the vertices in as many clusters: only their means and components are no more
    twice = replace(SIZE, n_verts=2 * SIZE.n_verts).work
    assert twice["trial_flops"] == pytest.approx(2.0 * before, rel=0.1)
    assert twice["trial_rays"] == 2.0 * SIZE.work["trial_rays"]
    assert replace(SIZE, n_verts=0).work == {}


def test_memory_holds_what_drawing_and_sampling_do():
    # measured by tracemalloc; the largest of three counts
    scene = Scene.from_parts([ball(6)])
    held = peak_of(
        lambda: draw_clusters(scene, 0, 100, rank=8, n_values=42, rng=np.random.default_rng(0))
    )
    foreseen = replace(SIZE, whole_verts=scene.n_vertices, n_verts=1).memory_bytes
    assert foreseen == pytest.approx(held, rel=0.25)
    verts = np.arange(800)
    directions = SampledDirections.of(BASIS, RESOLUTION)
    held = peak_of(lambda: sampled_coefficients(POT, verts, MATT, BLOCKED, directions))
    assert SIZE.memory_bytes == pytest.approx(held, rel=0.25)


@pytest.mark.parametrize("compression", [LONE, TENSOR], ids=["cpca", "cta"])
def test_memory_holds_what_compressing_does(rng, compression):
    size = replace(SIZE, n_verts=256, n_terms=4, n_coeffs=642, compression=compression)
    coefficients = rng.standard_normal((256, 4, 642), np.float32)
    whole = WholePart(1000, compression, 10_000, None)

    def compressed():
        copy = np.tile(coefficients, (1, 1, 1))
        factor_bytes(copy, np.ones(256), compression.n_clusters, whole, share=SHARE)

    held = coefficients.nbytes + peak_of(compressed)
    assert size.memory_bytes == pytest.approx(held, rel=0.1)
    # negative twin: neither drawing nor sampling holds as much
    assert replace(size, n_coeffs=1).memory_bytes < 0.5 * held


def peak_of(call):
    tracemalloc.start()
    call()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak
