"""The plan solves the basis once; no tile and no join does so again."""

import numpy as np
import pytest

from prtbake_storage.queue.stages import Results
from prtbake_workers.basis import projection as projection_module
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.scene_file import make_basis, read_projection, read_scene
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.mirrored import product_of
from support.local_stages import run_stages
from support.scenes import asset_request, context_of

BAKE = {"cube_resolution": 8, "n_centres": 42}


class Solved(Exception):
    pass


@pytest.fixture(scope="module")
def stages(store):
    request = asset_request(receiver=None, settings={"bake": BAKE})
    context = context_of(
        store,
        request,
        {"builtin": {"name": "icosphere", "tessellation": 2}},
        {"builtin": {"name": "sun_sky", "width": 32}},
    )
    found = REGISTRY.stages("asset", request, context)
    return found[: [stage.name for stage in found].index("join") + 1]


@pytest.fixture(scope="module")
def planned(store, stages):
    return run_stages(stages[:1], store)


def test_tiles_and_join_solve_nothing(store, stages, planned, monkeypatch):
    def refuse(*_args, **_kwargs):
        raise Solved

    with monkeypatch.context() as patched:
        patched.setattr(np.linalg, "eigh", refuse)
        patched.setattr(projection_module, "cho_factor", refuse)
        results = Results()
        results.add("plan", planned["plan"], [])
        for stage in stages[1:]:
            done = run_stages([_given(stage, results)], store)
            results.add(stage.name, done[stage.name], [])
        assert results["join"][0]["bytes"] > 0
        # negative twins: what they did before, and what they would do without the product
        with pytest.raises(Solved):
            make_basis(read_scene(store.local_path(planned["plan"][0]["scene"])).header["bake"])
        stored = read_projection(store.local_path(planned["plan"][0]["projection"]))
        with pytest.raises(Solved):
            product_of(stored.projection, cube_directions(BAKE["cube_resolution"]).directions)


def _given(stage, results):
    """The stage, after results that another run left."""
    return type(stage)(stage.name, stage.unit, stage.weight, lambda _: stage.tasks(results))


def test_the_stored_basis_is_the_solved_one_to_the_last_bit(store, planned):
    path = store.local_path(planned["plan"][0]["projection"])
    stored = read_projection(path)
    bake = read_scene(store.local_path(planned["plan"][0]["scene"])).header["bake"]
    solved = make_basis(bake)
    directions = cube_directions(5).directions
    expected = solved.reconstruction_matrix(directions)
    assert stored.functions.reconstruction_matrix(directions).tobytes() == expected.tobytes()
    cube = cube_directions(bake["cube_resolution"])
    again = solved.projection(cube.directions, stored.projection.weights)
    assert stored.projection.samples.tobytes() == again.samples.tobytes()
    product, _ = product_of(again, cube.directions).tables()
    found, _ = stored.product.tables()
    assert {name: array.tobytes() for name, array in found.items()} == {
        name: array.tobytes() for name, array in product.items()
    }
