"""A worker's death and a cancellation in the middle of a bake, and what must hold after them."""

import signal
import time
from collections.abc import Callable, Sequence
from typing import Any

import psutil

from prtbake_storage.contract.jobs import Job, JobState
from prtbake_storage.queue.memo import recall
from prtbake_storage.queue.stages import Results, Task
from prtbake_workers.jobs.registry import REGISTRY
from support.deployment import PATIENCE_S, Installation, is_alive, until
from support.rows import context_of

BAKE = 1
"""Where the bake stands among the stages."""


def survives_a_kill(
    installation: Installation,
    request: dict[str, Any],
    undisturbed: Job,
    *,
    patience_s: float = PATIENCE_S,
) -> None:
    """Kill the worker that walks through a job in the middle of its bake, and check the outcome.

    The job ends by itself, no finished tile is redone, and every dataset is that of a run that
    nobody disturbed.
    """
    job_id = installation.client.submit(request).id
    until(lambda: bool(bake_tasks(installation, job_id)), "the plan")
    tiles = bake_tasks(installation, job_id)
    assert len(tiles) >= 8
    until(lambda: len(finished(installation, tiles)) >= 2, "two tiles", patience_s)
    victim, orphans = stopped_in_the_middle(installation, job_id)
    before = finished(installation, tiles)
    assert 2 <= len(before) < len(tiles) - 1
    victim_id = next(k for k, v in installation.workers().items() if v.pid == victim.pid)
    victim.send_signal(signal.SIGKILL)
    until(lambda: not any(map(is_alive, orphans)), "its children's death", 10.0)

    job = installation.client.wait(job_id, timeout_s=patience_s, check=False)
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
    for artefact in undisturbed.artefacts:
        if artefact.name.endswith(".h5"):
            assert digests[artefact.name] == artefact.sha256, artefact.name
    assert set(digests) == {artefact.name for artefact in undisturbed.artefacts}
    fractions = [
        event.data["fraction"]
        for event in installation.client.events(job_id)
        if event.type == "progress"
    ]
    assert fractions == sorted(fractions)
    until(lambda: len(installation.workers()) == 2, "a worker in the victim's place")
    until(lambda: not installation.leftovers(), "scratch to be swept", 60.0)


def leaves_nothing_when_canceled(installation: Installation, request: dict[str, Any]) -> float:
    """Cancel a job in the middle of its bake and check what is left; returns the seconds it took.

    The CPU is free within 2 s, no artefact is visible, and no file is left.
    """
    job = installation.client.submit(request)
    until(lambda: len(working(installation)) == 2, "a tile on each worker")
    children = working(installation)
    blobs = {blob.digest for blob in installation.store.blobs()}
    freed_s = seconds_to_free(lambda: installation.client.cancel(job.id), children)
    assert freed_s < 2.0
    ended = installation.client.wait(job.id, timeout_s=60.0, check=False)
    assert (ended.state, ended.artefacts, ended.result) == (JobState.canceled, [], None)
    assert installation.client.artefacts(job.id) == []
    assert installation.tasks() == []
    assert installation.leftovers() == []
    assert {blob.digest for blob in installation.store.blobs()} == blobs
    assert len(installation.workers()) == 2
    return freed_s


def seconds_to_free(cancel: Callable[[], object], processes: Sequence[psutil.Process]) -> float:
    """Cancel, and tell how long after the asking none of the processes lives any more."""
    begin = time.monotonic()  # the caller's wait for the answer counts
    cancel()
    until(lambda: not any(map(is_alive, processes)), "the CPU")
    return time.monotonic() - begin


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
