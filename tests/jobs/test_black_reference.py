"""A view that no light reaches: the job ends with figures, not with an error."""

import json

import numpy as np

from prtbake_storage.hdf5.resources import EnvironmentFile, write_environment
from prtbake_workers.jobs.registry import REGISTRY
from support.local_stages import registered
from support.scenes import asset_request, run_asset

TOP_CAP = {"name": "top", "eye": [0.0, 12.0, 0.0], "up": [0.0, 0.0, 1.0], "fov_deg": 4.0}


def lit_from_below(store, path):
    """Light in the lowest rows of a lat-long map alone."""
    radiance = np.zeros((16, 32, 3), np.float32)
    radiance[-2:] = 1.0
    write_environment(path, EnvironmentFile(radiance, {}))
    return {"canonical": store.put_file(path)}


def test_a_black_view_ends_in_a_report(store, tmp_path):
    request = asset_request(
        brdf={"model": "lambert"},
        receiver=None,
        settings={"bake": {"n_centres": 42}, "validation": {"cameras": [TOP_CAP]}},
    )
    context = {
        "mesh": registered(store, "mesh", builtin={"name": "icosphere", "tessellation": 3}),
        "brdf": {"spec": request["brdf"]},
        "environment": lit_from_below(store, tmp_path / "environment.h5"),
        "artefacts": {},
    }
    results = run_asset(store, request, context)
    finished = REGISTRY.finish("asset", request, context, results)
    (metrics,) = finished.result["metrics"]
    # 42 SRBFs ring: the delivered picture is not as black as the reference
    assert metrics["pixels"] > 100
    assert metrics["max_abs"] > 0.0
    assert metrics["black_reference"]
    assert (metrics["relative_l2"], metrics["rel_mse"]) == (None, None)
    assert finished.result["budget"]["black_reference"]
    assert "reference is black" in finished.result["summary"]
    files = {file.name: file.digest for file in finished.artefacts}
    json.loads(store.read_bytes(files["report.json"]))
    assert "(black reference)" in store.read_bytes(files["report.html"]).decode()
