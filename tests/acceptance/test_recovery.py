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
from prtbake_storage.contract.jobs import JobState, job_request_adapter
from prtbake_storage.records import Events, NewJob
from support.deployment import (
    PATIENCE_S,
    Installation,
    free_port,
    until,
)
from support.disturbance import leaves_nothing_when_canceled, survives_a_kill
from support.main_job import GLOSSY, HEAVY_BAKE, Finished, main_request

pytestmark = pytest.mark.acceptance

COMPRESS = 1
"""Where the fit stands among the stages of a compression."""

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


def test_kill_9_in_the_middle_of_shared_steps(installation: Installation) -> None:
    """Steps of a compression shared by three tasks leave the file of one, whoever dies."""
    client = installation.client
    bake = {"cube_resolution": 8, "n_centres": 42, "n_terms": 8}
    baked = client.submit(
        {"kind": "bake", "mesh": installation.mesh, "brdf": GLOSSY, "settings": bake}
    )
    assert client.wait(baked.id, timeout_s=PATIENCE_S).state is JobState.succeeded
    settings = {"max_iterations": 3, "n_clusters": 6, "ranks": [4, 12, 8]}

    def submit(step_tasks: int) -> str:
        return client.submit(
            {
                "kind": "compress",
                "transfer": f"{baked.id}/transfer.h5",
                "settings": settings | {"step_tasks": step_tasks},
            }
        ).id

    whole, shared = submit(1), submit(3)
    # a start, then rounds of three
    until(lambda: (COMPRESS, 5) in installation.starts(shared), "the third round", PATIENCE_S)
    victim = installation.workers()[installation.log(shared, "task.started")[-1]["worker"]]
    victim.kill()
    files = [
        {artefact.name: artefact.sha256 for artefact in client.wait(job).artefacts}
        for job in (whole, shared)
    ]
    for name in ("asset.h5", "asset-float32.h5"):
        assert files[0][name] == files[1][name], name
    started = {position for stage, position in installation.starts(shared) if stage == COMPRESS}
    # model step, classification, view basis and last bases at least, and the finish
    assert started == set(range(max(started) + 1))
    assert max(started) >= 3 * 4 + 1
    assert {at for at in installation.starts(whole) if at[0] == COMPRESS} == {(COMPRESS, 0)}
    progress = [event.data for event in client.events(shared) if event.type == "progress"]
    fractions = [one["fraction"] for one in progress]
    assert fractions == sorted(fractions)
    assert any(one["unit"] == "rounds" for one in progress)
    until(lambda: len(installation.workers()) == 2, "a worker in the victim's place")


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
