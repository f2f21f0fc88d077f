"""Deaths and cancellations in the middle of the main job, on both databases."""

import os
import signal
import subprocess
import sys
import uuid
from typing import Any

import httpx
import pytest

from prtbake import Client, ServiceUnreachable
from prtbake.config import read_key
from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.records import Events, NewJob
from support.deployment import (
    Installation,
    free_port,
    until,
)
from support.disturbance import leaves_nothing_when_canceled, survives_a_kill
from support.main_job import HEAVY_BAKE, Finished, main_request

pytestmark = pytest.mark.acceptance

# a service that is killed by its own first word to the engine: after the row's commit, before the
# engine's
DOOMED_SERVICE = """
import os, signal
from prtbake_service.main import main
from prtbake_storage.queue.engine import JobQueue
JobQueue.submit = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
main()
"""


def test_kill_9_in_the_middle_of_the_bake(
    installation: Installation, undisturbed: Finished
) -> None:
    survives_a_kill(installation, main_request(installation), undisturbed.job)


def test_cancel_in_the_middle_frees_the_cpu_and_leaves_nothing(
    installation: Installation,
) -> None:
    leaves_nothing_when_canceled(installation, HEAVY_BAKE | {"mesh": installation.mesh})


def test_a_row_that_was_never_queued_runs_once(installation: Installation) -> None:
    request = small_fit(installation, seed=11)
    sky = installation.client.resource(installation.environment)
    new = NewJob(
        id="only-a-row",
        kind="fit_light",
        request=job_request_adapter.validate_python(request).model_dump(mode="json"),
        context={"environment": {"id": sky.id, "canonical": sky.canonical, "understood": {}}},
    )
    _, is_new = installation.jobs.create(new)
    assert is_new
    ran_once(installation, "only-a-row")


def test_kill_9_of_the_service_between_two_commits(installation: Installation) -> None:
    port, job_id = free_port(), f"half-submitted-{uuid.uuid4().hex[:8]}"
    request = small_fit(installation, seed=12)
    doomed = subprocess.Popen(
        [sys.executable, "-c", DOOMED_SERVICE],
        env=os.environ | {
            "PRTBAKE_DATA_DIR": str(installation.folder),
            "PRTBAKE_DATABASE_URL": installation.database_url,
            "PRTBAKE_PORT": str(port),
        },
        stderr=subprocess.DEVNULL,
    )  # fmt: skip
    url = f"http://127.0.0.1:{port}"
    try:
        until(lambda: answers(url), "the second service", 120.0)
        with (
            Client(url, key=read_key(installation.folder), retries=0) as client,
            pytest.raises(ServiceUnreachable),
        ):
            client.submit(request, job_id=job_id)
        assert doomed.wait(timeout=30.0) == -signal.SIGKILL
    finally:
        doomed.kill()
        doomed.wait()
    # a caller who heard nothing asks again, and gets the same job
    assert installation.client.submit(request, job_id=job_id).id == job_id
    ran_once(installation, job_id)


def small_fit(installation: Installation, seed: int) -> dict[str, Any]:
    """A light fit that nobody has asked for yet, so that all of its tasks must run."""
    return {
        "kind": "fit_light",
        "environment": installation.environment,
        "seed": seed,
        "settings": {"n_lobes": 12, "max_iterations": 1},
    }


def ran_once(installation: Installation, job_id: str) -> None:
    """Wait for a job's end and count what was run for it."""
    job = installation.client.wait(job_id, timeout_s=120.0)
    assert [artefact.name for artefact in job.artefacts] == [
        "light.h5", "report.json", "report.html",
    ]  # fmt: skip
    states = [
        event.data["state"]
        for event in Events(installation.database).after(job_id)
        if event.type == "state"
    ]
    assert states == ["queued", "running", "succeeded"]
    assert len(installation.log(job_id, "job.started")) == 1
    assert installation.starts(job_id) == {(0, 0): 1, (1, 0): 1}


def answers(url: str) -> bool:
    """Whether a service listens."""
    try:
        return httpx.get(f"{url}/healthz", timeout=2.0, trust_env=False).status_code == 200
    except httpx.TransportError:
        return False
