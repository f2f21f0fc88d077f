"""The database goes away in the middle of a job and comes back."""

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))

from fleet import Fleet

from prtbake_storage.testing.postgres import Server, private_server

pytestmark = [pytest.mark.acceptance, pytest.mark.own_postgres]

OUTAGE_S = 3.0
"""Longer than a tile, so that both workers finish one while nobody can be told."""


@pytest.fixture
def server() -> Iterator[Server]:
    """A PostgreSQL of one's own."""
    with private_server() as server:
        yield server


@pytest.fixture
def fleet(server: Server, tmp_path: Path) -> Iterator[Fleet]:
    """Two supervised workers on it."""
    fleet = Fleet(tmp_path, server.url)
    fleet.supervise(2)
    yield fleet
    fleet.close()


def test_a_job_outlives_a_restart_of_postgresql(server: Server, fleet: Fleet) -> None:
    assert fleet.supervisor is not None
    workers = fleet.supervisor.workers
    job_id = fleet.submit(n=6, seconds=1.0, seed=1)
    fleet.await_note("finished", "1-", 2)
    fleet.await_running("1-")
    server.stop()
    try:
        time.sleep(OUTAGE_S)
        during = set(fleet.counts("finished", "1-"))
    finally:
        server.start()
    job = fleet.ended(job_id)
    assert job.state == "succeeded", job.error
    assert len(during) >= 3
    # neither those finished before nor those finished while the database was away
    assert fleet.counts("started", "1-") == {f"1-{index}": 1 for index in range(6)}
    assert fleet.supervisor.workers == workers
