"""What the stages of a bake are predicted to hold, against the processes that run them."""

import pytest

from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.planning.cost import CHILD_BYTES, plan_memory_bytes, tile_memory_bytes
from prtbake_workers.planning.presets import PlannedBake
from support.local_stages import run_stage
from support.scenes import asset_request, context_of, teapot_context
from support.task_child import run_child

BAKE = {"cube_resolution": 24, "n_centres": 642, "n_terms": 16, "tile_vertices": 256}


def test_planning_and_a_tile_hold_what_is_predicted(store):
    request = asset_request(receiver=None, settings={"bake": BAKE})
    stages = REGISTRY.stages("asset", request, teapot_context(store, request))
    results = Results()
    (task,) = stages[0].tasks(results)
    planned = run_child(task, store)
    results.add("plan", [planned.result], [planned.measured])
    start, stop = planned.result["plan"]["parts"][0]["tiles"][0]
    tile = run_child(stages[1].tasks(results)[0], store)

    bake = PlannedBake.model_validate(BAKE)
    held = {
        "plan": (planned.measured.peak_memory_bytes, plan_memory_bytes(bake)),
        "bake": (
            tile.measured.peak_memory_bytes,
            tile_memory_bytes(bake, n_terms=16, n_verts=stop - start),
        ),
    }
    for measured, predicted in held.values():
        # within 10 % at 162, 642 and 2562 functions; an interpreter with other libraries differs
        assert predicted == pytest.approx(measured, rel=0.3)
    # negative twin: at other settings it is another figure
    other = bake.model_copy(update={"n_centres": 2562})
    assert plan_memory_bytes(other) > 2.0 * held["plan"][0]
    assert tile_memory_bytes(other, n_terms=16, n_verts=stop - start) > 2.0 * held["bake"][0]


def test_planning_that_chooses_holds_what_is_predicted(store):
    """Samples of two glossy parts, in all directions that are tried."""
    bake = {"cube_resolution": "auto", "n_centres": "auto", "n_terms": 16}
    glossy = {"model": "cook_torrance", "m": 0.2}
    request = asset_request(
        brdf=glossy,
        receiver={"brdf": glossy, "resolution": 24},
        effects={"interreflection": "off"},
        settings={"bake": bake | {"projection_tolerance": 0.3}},
    )
    stages = REGISTRY.stages("asset", request, teapot_context(store, request))
    done = run_child(stages[0].tasks(Results())[0], store)
    predicted = done.result["plan"]["memory_bytes"]["plan"]
    # an interpreter with other libraries differs
    assert predicted == pytest.approx(done.measured.peak_memory_bytes, rel=0.3)
    # negative twin: the numbers that were chosen take less by themselves
    chosen = PlannedBake.model_validate(done.result["settings"]["bake"])
    assert plan_memory_bytes(chosen) < 0.6 * predicted


def test_scattering_and_bounces_hold_what_is_predicted(store):
    """A ball of marble on a plane, with fine clusters: rows and transfer are most of it."""
    bake = {"cube_resolution": 6, "n_centres": 642, "bounce_rays": 32, "max_bounces": 1}
    request = asset_request(
        brdf={"model": "lambert", "albedo": 0.9},
        subsurface={"medium": "marble", "mm_per_unit": 2.0},
        receiver={"resolution": 48, "albedo": 0.5},
        effects={"interreflection": "on"},
        settings={"bake": bake | {"subsurface_tolerance": 1e-6}},
    )
    ball = {"builtin": {"name": "icosphere", "tessellation": 4}}
    context = context_of(store, request, ball, {"builtin": {"name": "sun_sky", "width": 32}})
    stages = {stage.name: stage for stage in REGISTRY.stages("asset", request, context)}
    results = Results()
    for name in ("plan", "bake"):
        run_stage(stages[name], results, store)
    predicted = results["plan"][0]["plan"]["memory_bytes"]
    for name in ("scattering", "bounces"):
        # one block of coefficients is as large as another
        done = run_child(stages[name].tasks(results)[0], store)
        results.add(name, [done.result], [done.measured])
        # within 20 % from 3,000 to 50,000 vertices; an interpreter with other libraries differs
        assert predicted[name] == pytest.approx(done.measured.peak_memory_bytes, rel=0.3)
        # negative twin: it is not the interpreter alone
        assert done.measured.peak_memory_bytes > 1.6 * CHILD_BYTES


def test_planning_in_harmonics_holds_what_is_predicted(store):
    """A tile only multiplies with what this made: one of SRBFs stands for both."""
    bake = BAKE | {"basis": "sh", "sh_order": 25}
    del bake["n_centres"]
    request = asset_request(receiver=None)
    request["settings"]["bake"] = bake
    stages = REGISTRY.stages("asset", request, teapot_context(store, request))
    (task,) = stages[0].tasks(Results())
    measured = run_child(task, store).measured.peak_memory_bytes
    settings = PlannedBake.model_validate(bake)
    # 7 % measured, see above
    assert plan_memory_bytes(settings) == pytest.approx(measured, rel=0.3)
    assert plan_memory_bytes(settings.model_copy(update={"sh_order": 50})) > 2.0 * measured
