"""Heartbeats of the worker processes, all by the database's clock."""

from collections.abc import Collection
from dataclasses import dataclass

import sqlalchemy as sa

from prtbake_storage.records.database import Database
from prtbake_storage.records.models import WorkerRow


@dataclass(frozen=True)
class Worker:
    """A worker process; ``age_s`` is the time since its last heartbeat."""

    executor_id: str
    host: str
    pid: int
    state: str
    tile_slots: int
    age_s: float


class Workers:
    """Reads and writes heartbeats."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def beat(self, executor_id: str, *, host: str, pid: int, tile_slots: int) -> None:
        """Say that a worker lives; the first beat enters it."""
        now = self._database.seconds
        with self._database.write() as session:
            beaten = session.execute(
                sa.update(WorkerRow)
                .where(WorkerRow.executor_id == executor_id)
                .values(last_seen_s=now)
                .returning(WorkerRow.executor_id)
            ).first()
            if beaten is None:
                session.execute(
                    sa.insert(WorkerRow).values(
                        executor_id=executor_id,
                        host=host,
                        pid=pid,
                        state="up",
                        tile_slots=tile_slots,
                        started_s=now,
                        last_seen_s=now,
                    )
                )

    def mark_gone(self, executor_id: str) -> None:
        """Say that a worker has ended: its work is free at once, without waiting for silence."""
        with self._database.write() as session:
            session.execute(
                sa.update(WorkerRow)
                .where(WorkerRow.executor_id == executor_id)
                .values(state="gone")
            )

    def all(self) -> list[Worker]:
        """Every worker that has not been forgotten."""
        age = self._database.seconds - WorkerRow.last_seen_s
        with self._database.read() as session:
            rows = session.execute(sa.select(WorkerRow, age).order_by(WorkerRow.executor_id))
            return [
                Worker(row.executor_id, row.host, row.pid, row.state, row.tile_slots, float(age_s))
                for row, age_s in rows
            ]

    def forget(self, executor_ids: Collection[str]) -> None:
        """Remove workers whose work has been given to others."""
        with self._database.write() as session:
            session.execute(
                sa.delete(WorkerRow).where(WorkerRow.executor_id.in_(list(executor_ids)))
            )
