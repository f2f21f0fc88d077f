"""From a worker's clock to predictions: a calibration, and a job that corrects it, through REST."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from prtbake.client import Client
from prtbake_service.testing import live_service, quick_settings
from prtbake_storage.contract.resources import MeshRegistration
from prtbake_storage.queue.settings import QueueSettings, new_executor_id
from prtbake_workers.planning.rates import SHIPPED, Rates

pytestmark = pytest.mark.acceptance

PATIENCE_S = 240.0


def test_a_worker_s_rates_come_to_lead_predictions(tmp_path: Path) -> None:
    with (
        (tmp_path / "worker.log").open("w") as log,
        live_service(quick_settings(tmp_path)) as service,
    ):
        settings = QueueSettings(data_dir=tmp_path, poll_s=0.1, retry_wait_s=0.1)
        here = [str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")]
        worker = subprocess.Popen(
            [
                sys.executable, "-m", "prtbake_storage.queue.worker_main",
                "--registry", "small_calibration:REGISTRY", "--executor-id", new_executor_id(),
            ],
            env={
                **os.environ,
                **settings.to_env(),
                "PYTHONPATH": os.pathsep.join(filter(None, here)),
            },
            stdout=log,
            stderr=log,
        )  # fmt: skip
        try:
            with Client(service.url, key=service.key) as client:
                _calibrate_and_correct(service.backend.rates.current, client)
        finally:
            worker.terminate()
            worker.wait(timeout=30.0)


def _calibrate_and_correct(current, client: Client) -> None:
    assert current()["calibration"] is None
    job = client.wait(client.submit({"kind": "calibrate"}).id, timeout_s=PATIENCE_S)
    assert job.result is not None
    stages = {one["stage"] for one in job.result["stages"]}
    assert {"plan", "bake", "join", "compress", "quantise", "fit_light", "render"} <= stages
    # the table holds what the worker measured, of every stage
    told = current()
    assert told["calibration"] == job.id
    assert set(told["seconds"]) == set(SHIPPED)
    for stage, units in told["seconds"].items():
        assert units == pytest.approx(job.result["seconds"][stage])
    assert told["seconds"]["fit_light"] != pytest.approx(SHIPPED["fit_light"])
    # stages without work in the trial keep what is shipped
    assert told["seconds"]["scattering"] == pytest.approx(SHIPPED["scattering"])

    mesh = client.register(
        MeshRegistration.model_validate({"builtin": {"name": "icosphere", "tessellation": 1}})
    )
    request = {
        "kind": "bake",
        "mesh": mesh.id,
        "brdf": {"model": "lambert", "albedo": 0.5},
        "effects": {"interreflection": "off"},
        "settings": {"n_centres": 42, "cube_resolution": 6},
    }
    estimate = client.estimate(request)
    amounts = estimate.plan["work"]
    calibrated = Rates.from_dict(told)
    for stage, seconds in estimate.seconds.items():
        if stage in amounts:
            assert seconds == pytest.approx(calibrated.stage_seconds(stage, amounts[stage]))
    # negative twin: by the shipped rates it would be another
    assert estimate.seconds["bake"] != pytest.approx(
        Rates().stage_seconds("bake", amounts["bake"]), rel=1e-6
    )
    assert told["factors"] == {}
    # a job that ends moves the factors of its stages, and so the next estimate
    client.wait(client.submit(request).id, timeout_s=PATIENCE_S)
    factors = current()["factors"]
    assert {"plan", "bake", "join"} <= set(factors)
    again = client.estimate(request)
    assert again.seconds["bake"] == pytest.approx(factors["bake"] * estimate.seconds["bake"])
