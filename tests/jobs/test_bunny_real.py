"""The bunny at the settings of Tsai and Shih's table 1: what the projection and CTA must reach."""

import pytest

from prtbake_storage.blobs.opening import open_store
from prtbake_workers.jobs.report import gather
from support.scenes import GLOSSY, asset_request, context_of, run_until

pytestmark = pytest.mark.real_data

SETTINGS = {
    "bake": {"cube_resolution": 32, "n_centres": 642, "n_terms": 16},
    "compress": {"n_clusters": 97, "ranks": [8, 48, 24], "max_iterations": 3},
}


@pytest.fixture(scope="module")
def results(tmp_path_factory, data_dir):
    store = open_store((tmp_path_factory.mktemp("bunny") / "blobs").as_uri())
    mesh = {"blob": store.put_file(data_dir / "meshes" / "stanford-bunny.obj")}
    # the plane's horizon is what is hard to project: alone the bunny has a third of the error
    request = asset_request(
        brdf=GLOSSY, quality="medium", receiver={"resolution": 24}, settings=SETTINGS
    )
    light = {"builtin": {"name": "constant", "width": 16}}
    return run_until(store, request, context_of(store, request, mesh, light), "compress")


def test_the_bunny_keeps_within_the_papers_errors(results):
    """Squared-error ratios in radiance norm; [Tsai2006]: 1.28 % and, with CTA, 3.64 % in all.

    The rows of ``make bench`` watch time and memory at these settings.
    """
    plan = results["plan"][0]["plan"]["parts"][0]
    assert plan["vertex_range"] == [0, 34_834]
    assert plan["n_terms"] == 16
    stages = {stage["name"]: stage for stage in gather("bunny", results)["stages"]}
    assert 0.010 < stages["bake"]["errors"]["object"] <= 0.015
    assert 0.004 < stages["compress"]["errors"]["object"] <= 0.007
    # the objective never rises by more than 1e-7 of the signal
    part = results["compress"][0]
    rises = [b - a for a, b in zip(part["objective"], part["objective"][1:], strict=False)]
    assert max(rises) <= 1e-7 * part["initial_energy"]
