"""Deaths and cancellations in the middle of the main job, on both databases."""

import os
import signal
import subprocess
import sys
import uuid
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import httpx
import psutil
import pytest

from prtbake import Client, ServiceUnreachable
from prtbake.config import read_key
from prtbake_storage.contract.jobs import JobState, job_request_adapter
from prtbake_storage.queue.memo import recall
from prtbake_storage.queue.stages import Results, Task
from prtbake_storage.records import Events, NewJob
from prtbake_storage.testing.postgres import fresh_database
from prtbake_workers.jobs.registry import REGISTRY
from support.deployment import (
    EAGER,
    Installation,
    free_port,
    installed,
    is_alive,
    until,
)
from support.main_job import HEAVY_BAKE, Finished, main_request
from support.rows import context_of

pytestmark = pytest.mark.acceptance

BAKE = 1
"""Where the bake stands among the stages."""
# a service that is killed by its own first word to the engine: after the row's commit, before the
# engine's
DOOMED_SERVICE = """
import os, signal
from prtbake_service.main import main
from prtbake_storage.queue.engine import JobQueue
JobQueue.submit = lambda *_, **__: os.kill(os.getpid(), signal.SIGKILL)
main()
"""


@pytest.fixture(
    scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.postgres)]
)
def installation(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Installation]:
    """A service and two workers; the URL alone tells the databases apart."""
    with ExitStack() as stack:
        url = None
        if request.param == "postgresql":
            url = stack.enter_context(fresh_database(request.getfixturevalue("postgres_url")))
        folder = tmp_path_factory.mktemp(request.param)
        yield stack.enter_context(installed(folder, database_url=url, settings=EAGER))


def test_kill_9_in_the_middle_of_the_bake(
    installation: Installation, undisturbed: Finished
) -> None:
    job_id = installation.client.submit(main_request(installation)).id
    until(lambda: bool(bake_tasks(installation, job_id)), "the plan")
    tiles = bake_tasks(installation, job_id)
    assert len(tiles) >= 8
    until(lambda: len(finished(installation, tiles)) >= 2, "two tiles")
    victim, orphans = stopped_in_the_middle(installation, job_id)
    before = finished(installation, tiles)
    assert 2 <= len(before) < len(tiles) - 1
    victim_id = next(k for k, v in installation.workers().items() if v.pid == victim.pid)
    victim.send_signal(signal.SIGKILL)
    until(lambda: not any(map(is_alive, orphans)), "its children's death", 10.0)

    job = installation.client.wait(job_id, timeout_s=240.0, check=False)
    assert job.state is JobState.succeeded, job.error
    after = finished(installation, tiles)
    assert {position: after[position] for position in before} == before, "a result was replaced"
    starts = installation.starts(job_id)
    assert all(starts[BAKE, position] == 1 for position in before)
    assert {position for stage, position in starts if stage == BAKE} == set(range(len(tiles)))
    # the walk through the stages, which the victim held, was taken up by another worker
    walkers = [one["worker"] for one in installation.log(job_id, "job.started")]
    assert walkers[0] == victim_id
    assert len(set(walkers)) == len(walkers) == 2
    # and so was the tile it was at, although the children of both had to be started anew
    interrupted = {
        one["position"]
        for one in installation.log(job_id, "task.started")
        if one["stage"] == BAKE and one["worker"] == victim_id and one["position"] not in before
    }
    assert len(interrupted) == 1
    assert all(starts[BAKE, position] == 2 for position in interrupted)

    digests = {artefact.name: artefact.sha256 for artefact in job.artefacts}
    for artefact in undisturbed.job.artefacts:
        if artefact.name.endswith(".h5"):
            assert digests[artefact.name] == artefact.sha256, artefact.name
    assert set(digests) == {artefact.name for artefact in undisturbed.job.artefacts}
    fractions = [
        event.data["fraction"]
        for event in installation.client.events(job_id)
        if event.type == "progress"
    ]
    assert fractions == sorted(fractions)
    until(lambda: len(installation.workers()) == 2, "a worker in the victim's place")
    until(lambda: not installation.leftovers(), "scratch to be swept", 60.0)


def test_cancel_in_the_middle_frees_the_cpu_and_leaves_nothing(
    installation: Installation,
) -> None:
    job = installation.client.submit(HEAVY_BAKE | {"mesh": installation.mesh})
    until(lambda: len(working(installation)) == 2, "a tile on each worker")
    children = working(installation)
    blobs = {blob.digest for blob in installation.store.blobs()}
    installation.client.cancel(job.id)
    freed_s = until(lambda: not any(map(is_alive, children)), "the CPU")
    assert freed_s < 2.0
    ended = installation.client.wait(job.id, timeout_s=60.0, check=False)
    assert (ended.state, ended.artefacts, ended.result) == (JobState.canceled, [], None)
    assert installation.client.artefacts(job.id) == []
    assert installation.tasks() == []
    assert installation.leftovers() == []
    assert {blob.digest for blob in installation.store.blobs()} == blobs
    assert len(installation.workers()) == 2


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


def bake_tasks(installation: Installation, job_id: str) -> list[Task]:
    """The tiles of a job whose plan is made; none before."""
    job = installation.jobs.get(job_id)
    stages = REGISTRY.stages(job.kind, job.request, context_of(installation.database, job_id))
    assert stages[BAKE].name == "bake"
    results = Results()
    (plan,) = stages[0].tasks(results)
    memory = recall(installation.store, plan.key)
    if memory is None:
        return []
    results.add(stages[0].name, [memory.result], [memory.measured])
    return stages[BAKE].tasks(results)


def finished(installation: Installation, tiles: list[Task]) -> dict[int, tuple[int, int]]:
    """The tiles that are remembered, by position: which file, and when it was made."""
    found = {}
    for position, task in enumerate(tiles):
        path = installation.folder / "blobs" / "results" / task.key[:2] / f"{task.key}.json"
        if path.exists():
            status = path.stat()
            found[position] = (status.st_ino, status.st_mtime_ns)
    return found


def stopped_in_the_middle(
    installation: Installation, job_id: str
) -> tuple[psutil.Process, list[psutil.Process]]:
    """Stop the worker that walks through the job while it runs a tile, and give both."""
    walker = installation.log(job_id, "job.started")[0]["worker"]
    victim = installation.workers()[walker]

    def caught() -> bool:
        # stopped first and looked at then: so the tile cannot end between look and kill
        victim.suspend()
        if installation.tasks(victim):
            return True
        victim.resume()
        return False

    until(caught, "a tile on the worker that holds the job")
    return victim, installation.tasks(victim)


def working(installation: Installation) -> list[psutil.Process]:
    """Task processes that are past their imports: they trace rays."""
    return [child for child in installation.tasks() if cpu_seconds(child) > 2.0]


def cpu_seconds(process: psutil.Process) -> float:
    """CPU time of a process so far."""
    try:
        times = process.cpu_times()
    except psutil.Error:
        return 0.0
    return float(times.user + times.system)


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
