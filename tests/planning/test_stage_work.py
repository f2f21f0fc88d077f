"""Counts of work: against what is really done, and how they grow."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import RenderSettings, ValidateSettings
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.primitives import sphere_mesh
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.jobs.cta_course import most_rounds
from prtbake_workers.planning.light_pieces import FitSamples
from prtbake_workers.planning.presets import PartCompression, PlannedBake
from prtbake_workers.planning.rates import SHIPPED
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.planning.stage_work import (
    bake_work,
    bounce_work,
    compress_work,
    fit_work,
    plan_work,
    quantise_work,
    render_work,
    shadow_rays,
    total,
    validate_work,
)
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.mirrored import product_of
from prtbake_workers.transport.plain_product import PlainProduct

SIZES = {"n_verts": 500, "n_terms": 4}
COMPRESSION = PartCompression("cta", 6, (3, 12, 8), 6)
DIFFUSE = PartCompression("cpca", 6, (1, 1, 1), 6)
BAKE = PlannedBake(cube_resolution=12, n_centres=162)


def counted(**changes):
    """All stages that a part goes through, by some sizes."""
    n_verts = changes.get("n_verts", SIZES["n_verts"])
    n_terms = changes.get("n_terms", SIZES["n_terms"])
    bake = BAKE.model_copy(update=changes.get("bake", {}))
    iterations = changes.get("iterations", 4)
    sizes = {"n_verts": n_verts, "n_terms": n_terms}
    validation = ValidateSettings(**changes.get("validation", {}))
    seen = [SeenPixels(300, min(n_verts, 200), 20, (300,))] * 2
    return {
        "plan": plan_work(bake, n_verts=n_verts, n_glossy=1, n_oriented=0),
        "bake": bake_work(bake, **sizes, shadows=True, n_tiles=2),
        "bounces": bounce_work(
            [n_verts], [n_terms], bounces=changes.get("bounces", 3), n_rays=[32], later_rays=[16],
            hit_share=0.3, n_channels=changes.get("n_channels", 1), n_coeffs=bake.n_coeffs,
            n_blocks=2,
        ),
        "compress": compress_work(
            COMPRESSION, **sizes, n_coeffs=bake.n_coeffs, iterations=iterations,
            n_channels=changes.get("n_channels", 1),
        ),
        "quantise": quantise_work(COMPRESSION, **sizes, n_coeffs=bake.n_coeffs, factor_floats=9999),
        "validate": validate_work(
            validation, bake, seen=seen, n_terms=n_terms, n_texels=2048, baked_bounces=True
        ),
        "render": render_work(RenderSettings(), n_verts=n_verts, n_values=n_verts * n_terms),
    }  # fmt: skip


def test_shared_steps_start_tasks_and_read_the_data_anew():
    sizes = SIZES | {"n_coeffs": 162, "iterations": 4}
    one, shared = (compress_work(replace(COMPRESSION, tasks=tasks), **sizes) for tasks in (1, 3))
    # start and finish, and three tasks of every other round
    assert shared["tasks"] == 2 + 3 * (most_rounds(4) - 2)
    assert shared["values"] == most_rounds(4) * one["values"]
    assert one["product_flops"] < shared["product_flops"] < 2.0 * one["product_flops"]
    assert shared["solve_flops"] == one["solve_flops"]


@pytest.mark.parametrize(
    ("grown", "changes"),
    [
        ({"plan", "bake", "bounces", "compress", "quantise", "render"}, {"n_verts": 900}),
        ({"bake", "bounces", "compress", "quantise", "validate", "render"}, {"n_terms": 9}),
        ({"plan", "bake", "validate"}, {"bake": {"cube_resolution": 16}}),
        ({"plan", "bake", "bounces", "compress", "quantise", "validate"},
         {"bake": {"n_centres": 642}}),
        ({"bake", "validate"}, {"bake": {"supersample": 2}}),
        ({"compress"}, {"iterations": 9}),
        ({"bounces"}, {"bounces": 5}),
        ({"bounces", "compress"}, {"n_channels": 3}),
        ({"validate"}, {"validation": {"passes": 16}}),
    ],
)  # fmt: skip
def test_more_of_anything_is_never_less_work(grown, changes):
    before, after = counted(), counted(**changes)
    for stage, amounts in before.items():
        assert set(amounts) == set(after[stage])
        assert all(after[stage][unit] >= amount for unit, amount in amounts.items()), stage
        # and it is told apart from what does not change
        assert (after[stage] != amounts) == (stage in grown), stage


def test_every_unit_has_a_rate_and_every_rate_a_unit():
    stages = counted()
    units = {stage: set(amounts) for stage, amounts in stages.items()}
    units["fit_light"] = set(fit_work(FitLightSettings(), n_texels=2048))
    for stage, own in units.items():
        extra = {
            "plan": {"outlines", "trial_rays", "trial_flops"},
            "quantise": {"tasks"},
            "compress": {"places", "moves"},
        }
        assert own | extra.get(stage, set()) == set(SHIPPED[stage]), stage


@given(
    st.lists(
        st.tuples(st.integers(1, 5000), st.integers(1, 40), st.integers(1, 9)),
        min_size=1, max_size=4,
    )
)  # fmt: skip
def test_parts_add_up(parts):
    """Two parts baked are the work of both, whichever comes first."""
    works = [
        bake_work(BAKE, n_verts=verts, n_terms=terms, shadows=True, n_tiles=tiles)
        for verts, terms, tiles in parts
    ]
    whole = total(works)
    assert whole == pytest.approx(total(reversed(works)), rel=1e-12)
    assert whole["rays"] == sum(shadow_rays(BAKE, n_verts=verts) for verts, *_ in parts)
    # a part of as many vertices, in one: rays, samples and values do not mind the cut
    split = total(
        bake_work(BAKE, n_verts=n, n_terms=3, shadows=True, n_tiles=1) for n in (100, 250)
    )
    joined = bake_work(BAKE, n_verts=350, n_terms=3, shadows=True, n_tiles=2)
    assert split == pytest.approx(joined, rel=1e-12)


@pytest.mark.parametrize("supersample", [1, 2])
def test_the_rays_counted_are_those_that_a_bake_casts(supersample):
    bake = PlannedBake(cube_resolution=6, n_centres=42, supersample=supersample)
    mesh = sphere_mesh(2)
    scene = Scene.from_parts([mesh])
    cube = cube_directions(6)
    basis = SrbfBasis(icosphere(1))
    block = bake_block(
        scene,
        Accelerator(scene.positions, scene.faces),
        (0, mesh.n_vertices),
        factorisation=factorise(Lambert(np.array([0.5])), n_terms=1),
        projection=basis.projection(cube.directions, cube.weights),
        directions=cube,
        supersample=supersample,
    )
    predicted = shadow_rays(bake, n_verts=mesh.n_vertices)
    # exact with a ray a direction: they are symmetric; with more, those at the horizon are not
    assert block.n_rays == pytest.approx(predicted, rel=0.0 if supersample == 1 else 0.03)
    # negative twin: all directions would be twice as many
    assert block.n_rays < 0.6 * mesh.n_vertices * cube.n * supersample**2


@pytest.mark.parametrize("fine", [12, 13])
def test_multiplications_are_halved_where_the_product_is(fine):
    cube = cube_directions(fine)
    projection = SrbfBasis(icosphere(2)).projection(cube.directions, cube.weights)
    plain = isinstance(product_of(projection, cube.directions), PlainProduct)
    assert plain == (fine == 13)
    own = BAKE.model_copy(update={"cube_resolution": fine})
    work = bake_work(own, **SIZES, shadows=True, n_tiles=1)
    other = bake_work(BAKE, **SIZES, shadows=True, n_tiles=1)
    share = fine**2 / 12**2
    assert work["flops"] == pytest.approx((2.0 if plain else 1.0) * share * other["flops"])
    for unit in ("rays", "samples"):
        assert work[unit] == pytest.approx(share * other[unit])


def test_no_shadows_cast_no_ray_and_no_bounce_traces_none():
    assert bake_work(BAKE, **SIZES, shadows=False, n_tiles=1)["rays"] == 0
    work = bounce_work(
        [500], [4], bounces=0, n_rays=[32], later_rays=[16], hit_share=0.3, n_channels=1,
        n_coeffs=162, n_blocks=2,
    )  # fmt: skip
    assert work["rays"] == work["sparse_flops"] == work["dense_flops"] == 0.0
    assert work["values"] == 500 * 4 * 162


def test_threads_share_what_a_task_does():
    one = bake_work(BAKE, **SIZES, shadows=True, n_tiles=1)
    three = bake_work(BAKE.model_copy(update={"threads": 3}), **SIZES, shadows=True, n_tiles=1)
    for unit in ("rays", "flops", "samples"):
        assert three[unit] == pytest.approx(one[unit] / 3.0)
    assert three["values"] == one["values"]
    plain = compress_work(DIFFUSE, n_verts=500, n_terms=1, n_coeffs=162, iterations=4)
    shared = compress_work(DIFFUSE, n_verts=500, n_terms=1, n_coeffs=162, iterations=4, threads=2)
    assert shared["product_flops"] == plain["product_flops"] / 2
    assert shared["values"] == plain["values"]


def test_a_media_s_pixels_cost_paths_of_their_own():
    settings = ValidateSettings()
    options = {"n_terms": 1, "n_texels": 2048}
    plain = validate_work(settings, BAKE, seen=[SeenPixels(400, 90, 0, (400,))], **options)
    media = validate_work(settings, BAKE, seen=[SeenPixels(400, 90, 100, (300, 100))], **options)
    assert plain["inside_paths"] == plain["paths"] == 0.0
    assert media["inside_paths"] == 100 * settings.passes * 4 * settings.paths
    both = validate_work(
        settings, BAKE, seen=[SeenPixels(400, 90, 100, (300, 100))], baked_bounces=True, **options
    )
    assert both["paths"] == 300 * settings.passes * settings.paths
    forbidden = settings.model_copy(update={"bounces": 0})
    assert (
        validate_work(
            forbidden, BAKE, seen=[SeenPixels(400, 90, 0, (400,))], baked_bounces=True, **options
        )["paths"]
        == 0.0
    )


def test_a_fit_sees_no_more_cells_than_texels():
    settings = FitLightSettings(n_lobes=64, max_iterations=2)
    small, large = (fit_work(settings, n_texels=n) for n in (512, 1 << 17))
    assert small["entries"] <= 2.0 * 64 * 512 * (2 * 10 + 8 + 8)
    assert small["texel_flops"] * 256 == pytest.approx(large["texel_flops"])
    assert small["entries"] < large["entries"]


def test_a_fit_s_work_goes_by_what_a_map_is_cut_into_and_not_by_its_texels():
    lamps = FitSamples(moving=30_000, solving=108_000, judging=245_000)
    for settings in (FitLightSettings(n_lobes=64), FitLightSettings(max_error=0.1)):
        plain, split = (fit_work(settings, n_texels=8192, samples=s) for s in (None, lamps))
        assert split["texel_flops"] > 10 * plain["texel_flops"]
        assert split["entries"] > plain["entries"]
    wavelets = [
        fit_work(FitLightSettings(method="wavelet", resolution=n), n_texels=512)["entries"]
        for n in (16, 64)
    ]
    assert wavelets[1] > 12 * wavelets[0]
