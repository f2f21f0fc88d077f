"""Settings of the queue, from ``PRTBAKE_*``."""

import socket
import uuid
from pathlib import Path
from typing import Annotated

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

Seconds = Annotated[float, Field(gt=0.0)]
Count = Annotated[int, Field(ge=1)]


REGISTRY = "prtbake_workers.jobs.registry:REGISTRY"
"""``module:attribute`` of the job kinds that workers run unless told otherwise."""


class QueueSettings(BaseSettings):
    """Where the queue lives and how eager it is; the URLs alone make it embedded or distributed.

    Attributes
    ----------
    data_dir
        Home of the defaults of both URLs.
    database_url
        ``sqlite:////path`` or ``postgresql://user@host/database``; the engine's own tables lie
        beside it (a file of its name and ``-engine``) or in it (schema ``dbos``).
    blob_url
        ``file:///directory``.
    heartbeat_s, dead_after_s
        A worker beats every ``heartbeat_s``; one silent for ``dead_after_s`` is declared dead.
    poll_s
        How often the queues of tasks and quick jobs, and waiting jobs, look at the database; the
        queue of long jobs looks half as often.
    cancel_check_s
        How often a running task asks whether it should stop.
    tile_slots, quick_slots, job_slots
        Tasks, quick jobs and waiting parents that a worker holds at once.
    task_attempts
        Runs of a task whose process dies by a signal or asks for a retry.
    worker_losses
        Workers that may be lost under one task before it is given up as poison.
    reconcile_s, retention_s
        How often rows and engine are compared; how long the engine's ended workflows and the rows
        of ended registrations and estimates are kept.
    garbage_every_s, garbage_grace_s
        How often a worker collects garbage; the age below which no blob and no remembered result
        goes.  The latter must exceed the longest task.
    """

    model_config = SettingsConfigDict(env_prefix="PRTBAKE_", extra="ignore")

    data_dir: Path = Path("prtbake-data")
    database_url: str = ""
    blob_url: str = ""
    heartbeat_s: Seconds = 5.0
    dead_after_s: Seconds = 30.0
    poll_s: Seconds = 0.25
    cancel_check_s: Annotated[float, Field(gt=0.0, le=0.5)] = 0.5
    tile_slots: Count = 1
    quick_slots: Count = 1
    job_slots: Count = 16
    task_attempts: Count = 3
    retry_wait_s: Seconds = 1.0
    worker_losses: Count = 3
    reconcile_s: Seconds = 10.0
    retention_s: Seconds = 7 * 86400.0
    garbage_every_s: Seconds = 3600.0
    garbage_grace_s: Annotated[float, Field(ge=86400.0)] = 7 * 86400.0

    def model_post_init(self, _context: object) -> None:
        """Fill in the URLs that follow from ``data_dir``."""
        home = self.data_dir.absolute()
        if not self.database_url:
            self.database_url = f"sqlite:///{home / 'prtbake.sqlite'}"
        if not self.blob_url:
            self.blob_url = (home / "blobs").as_uri()

    def to_env(self) -> dict[str, str]:
        """Write as environment variables, for a worker process."""
        return {
            f"PRTBAKE_{name.upper()}": str(value)
            for name, value in self.model_dump(mode="json").items()
        }


def new_executor_id() -> str:
    """Name a worker process, anew at every start, so that none takes another's work for its own."""
    return f"{socket.gethostname()[:60]}-{uuid.uuid4().hex[:12]}"
