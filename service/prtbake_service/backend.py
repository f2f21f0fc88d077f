"""What the endpoints stand on: records, blobs and queue, opened once a process."""

import threading
from dataclasses import dataclass, field
from typing import Annotated

from fastapi import Depends, Request

from prtbake_service.health.metrics import Metrics
from prtbake_service.settings import ServiceSettings
from prtbake_storage.blobs import BlobStore, open_store
from prtbake_storage.queue.engine import JobQueue
from prtbake_storage.queue.settings import new_executor_id
from prtbake_storage.records import (
    CostRates,
    Database,
    Events,
    Jobs,
    Keys,
    Registrations,
    Resources,
    Uploads,
    Workers,
    create_database,
)
from prtbake_storage.records.workers import Worker


@dataclass(frozen=True)
class Backend:
    """The service's view of the storage.

    Attributes
    ----------
    closing
        Set when the process has been asked to leave: whoever waits for something answers at once.
    """

    settings: ServiceSettings
    database: Database
    jobs: Jobs
    events: Events
    resources: Resources
    registrations: Registrations
    uploads: Uploads
    workers: Workers
    keys: Keys
    rates: CostRates
    blobs: BlobStore
    queue: JobQueue
    metrics: Metrics
    closing: threading.Event = field(default_factory=threading.Event)

    @classmethod
    def open(cls, settings: ServiceSettings, metrics: Metrics) -> "Backend":
        """Open everything; the database is brought up to date first."""
        database = create_database(settings.database)
        return cls(
            settings=settings,
            database=database,
            jobs=Jobs(database),
            events=Events(database),
            resources=Resources(database),
            registrations=Registrations(database),
            uploads=Uploads(database),
            workers=Workers(database),
            keys=Keys(database),
            rates=CostRates(database),
            blobs=open_store(settings.blobs, owner=f"service-{new_executor_id()}"),
            queue=JobQueue(settings.database),
            metrics=metrics,
        )

    def close(self) -> None:
        """Close all connections."""
        self.queue.close()
        self.database.dispose()

    def workers_alive(self) -> int:
        """Count the workers whose heart beat lately."""
        return len(self._alive())

    def tile_slots(self) -> int:
        """Count the tasks that live workers can run beside each other."""
        return sum(worker.tile_slots for worker in self._alive())

    def _alive(self) -> list[Worker]:
        limit_s = self.settings.worker_dead_after.total_seconds()
        return [
            worker
            for worker in self.workers.all()
            if worker.state == "up" and worker.age_s <= limit_s
        ]


def backend_of(request: Request) -> Backend:
    """Return the backend of the application that a request came to."""
    backend = request.app.state.backend
    if not isinstance(backend, Backend):
        raise TypeError("the application has not started")
    return backend


BackendDep = Annotated[Backend, Depends(backend_of)]
