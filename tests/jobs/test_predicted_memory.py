"""What planning and a tile are predicted to hold, against the processes that run them."""

import pytest

from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.planning.cost import plan_memory_bytes, tile_memory_bytes
from prtbake_workers.planning.presets import PlannedBake
from support.scenes import asset_request, teapot_context
from support.task_child import run_child

BAKE = {"cube_resolution": 32, "n_centres": 642, "n_terms": 16, "tile_vertices": 1024}


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
