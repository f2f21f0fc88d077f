"""The chain of pictures on a small scene: the budget closes, and frames do not matter."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_storage.contract.brdf import PhongSpec
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.registry import brdf_from_spec
from prtbake_workers.environment.sampling import EnvironmentSampler
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.validation.chain import BOUNCED_LINE, LINES, fitted_light, validate_camera
from prtbake_workers.validation.exact_terms import ExactTerms
from prtbake_workers.validation.hits import trace_camera
from prtbake_workers.validation.light import draw_pass
from prtbake_workers.validation.monte_carlo import pixel_pictures, vertex_terms
from prtbake_workers.validation.sampled import asset_picture, sampled_terms
from support.local_stages import run_stages
from support.scenes import (
    SMALL,
    asset_request,
    relative_difference,
    run_until,
    teapot_context,
    validation_of,
)

SETTINGS = ValidateSettings(width=48, height=36, passes=4, samples=64)
FULL_RANKS = [16, 162, 600]
"""All terms, all coefficients, and more vertices than a cluster holds."""


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return open_store((tmp_path_factory.mktemp("chain") / "blobs").as_uri())


def bake(store, **settings):
    """Context and results of every stage before the pictures."""
    request = asset_request(settings={"bake": settings})
    context = teapot_context(store, request, 3)
    return context, run_until(store, request, context, "fit_light")


@pytest.fixture(scope="module")
def plain_bake(store):
    return bake(store)


@pytest.fixture(scope="module")
def turned_bake(store):
    return bake(store, frame_seed=3)


def scene_of(store, baked):
    context, results = baked
    return validation_of(store, results, context["environment"]["canonical"])


def uncut_scene_of(store, baked):
    """The same transfer compressed to full ranks."""
    context, results = baked
    request = {
        "kind": "compress", "transfer": "job/transfer.h5",
        "settings": SMALL["compress"] | {"ranks": FULL_RANKS},
    }  # fmt: skip
    transfer = {"transfer": {"digest": results["join"][0]["transfer"]}}
    stages = REGISTRY.stages("compress", request, {**context, "artefacts": transfer})
    uncut = {**results, "quantise": run_stages(stages, store)["quantise"]}
    return scene_of(store, (context, uncut))


@pytest.fixture(scope="module")
def validation(store, plain_bake):
    return scene_of(store, plain_bake)


@pytest.fixture(scope="module")
def plain(validation):
    rotations = [np.eye(3), rotation_matrix((0.0, 90.0, 0.0))]
    return validate_camera(validation, Camera(), rotations, SETTINGS, seed=1)


def test_the_budget_closes(plain):
    for view in plain:
        expected = [BOUNCED_LINE if name == "16-bit transfer" else name for name in LINES[1:]]
        assert [line.name for line in view.budget.lines] == expected
        assert view.budget.total <= view.budget.sum_of_lines * (1 + 1e-9)
        assert view.budget.total >= view.budget.sum_of_lines / 3


def test_turning_the_light_changes_the_pictures(plain):
    assert relative_difference(plain[1].delivered, plain[0].delivered) > 0.05


def test_the_delivered_picture_resembles_the_reference(plain):
    assert 0.0 < plain[0].budget.total < 0.4


def picture(view, name):
    return view.chain[LINES.index(name)].mean


def test_random_frames_change_no_picture(store, turned_bake, plain):
    """Terms come in whole +-m pairs, so a turn of a frame is a rotation within them.

    What is left is float32 and 16-bit rounding of the transfer: 1e-5 was measured.
    """
    scene = scene_of(store, turned_bake)
    turned = validate_camera(scene, Camera(), [np.eye(3)], SETTINGS, seed=1)
    for name in ("K terms", "vertex interpolation", "SRBF basis", "16-bit transfer"):
        assert relative_difference(picture(turned[0], name), picture(plain[0], name)) < 1e-3


def test_random_frames_change_no_delivered_picture(store, plain_bake, turned_bake):
    """Uncut, so that nothing but the frames can tell the two assets apart."""
    plain, turned = (uncut_scene_of(store, baked) for baked in (plain_bake, turned_bake))
    hits = trace_camera(plain, Camera(), SETTINGS.width, SETTINGS.height)
    light = fitted_light(plain, np.eye(3))
    expected = asset_picture(plain.delivered, light, hits)
    # 16 bits in transfer and factors: 1e-4 was measured
    assert relative_difference(asset_picture(turned.delivered, light, hits), expected) < 1e-3
    # negative twin: the terms of one asset in the frames of the other
    swapped = [
        replace(part, frames=other.frames)
        for part, other in zip(turned.delivered.parts, plain.delivered.parts, strict=True)
    ]
    wrong = asset_picture(replace(turned.delivered, parts=tuple(swapped)), light, hits)
    assert relative_difference(wrong, expected) > 0.02


def test_memory_does_not_grow_with_the_terms(validation, rng):
    """127 terms, and rays for twice as many values as a block may hold."""
    brdf = brdf_from_spec(PhongSpec(exponent=200))
    sharp = factorise(brdf, n_terms=127)
    part = replace(validation.parts[0], brdf=brdf, factorisation=sharp, view_texture=None)
    scene = replace(validation, parts=(part, *validation.parts[1:]))
    hits = trace_camera(scene, Camera(), 64, 48)
    exact = [ExactTerms(own.factorisation) for own in scene.parts]
    light = draw_pass(EnvironmentSampler(scene.environment), np.eye(3), 250, rng)
    own = hits.vertices_of(*scene.scene.part_ranges[0])
    columns = rng.random((scene.directions.n, 6))
    for render in (
        lambda: pixel_pictures(scene, hits, light, exact, 1e-4),
        lambda: vertex_terms(scene, part, np.tile(own, 2), light, 1e-4),
        lambda: sampled_terms(scene, 0, own[:120], columns),
    ):
        tracemalloc.start()
        render()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        # measured 0.19 to 0.26 GB; blocks that heed rays alone take 0.86 GB for the pixels
        assert peak < 0.3e9
