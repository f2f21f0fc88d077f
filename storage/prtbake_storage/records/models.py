"""The tables."""

from datetime import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from prtbake_storage.contract.jobs import JobState
from prtbake_storage.records.clock import UtcDateTime

_Json = sa.JSON(none_as_null=True)
# SQLite counts up by itself only for its own INTEGER
_Serial = sa.BigInteger().with_variant(sa.Integer(), "sqlite")
_Seconds = sa.Float(53)
_STATES = ", ".join(f"'{state}'" for state in JobState)


class Base(DeclarativeBase):
    """Names every constraint, so that migrations can name them too."""

    metadata = sa.MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "ck": "ck_%(table_name)s_%(constraint_name)s",
            "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class JobRow(Base):
    """A job: the API's source of truth."""

    __tablename__ = "jobs"
    __table_args__ = (
        sa.CheckConstraint(f"state IN ({_STATES})", name="state"),
        sa.UniqueConstraint("project", "idempotency_key"),
        sa.Index("ix_jobs_project_created_id", "project", "created", "id"),
        sa.Index("ix_jobs_state", "state"),
    )

    id: Mapped[str] = mapped_column(sa.String(64), primary_key=True)
    project: Mapped[str] = mapped_column(sa.String(100))
    kind: Mapped[str] = mapped_column(sa.String(40))
    internal: Mapped[bool]
    quick: Mapped[bool]
    state: Mapped[str] = mapped_column(sa.String(20))
    cause: Mapped[str | None] = mapped_column(sa.String(40))
    stopping: Mapped[dict[str, Any] | None] = mapped_column(_Json)
    revision: Mapped[int]
    request: Mapped[dict[str, Any]] = mapped_column(_Json)
    context: Mapped[dict[str, Any]] = mapped_column(_Json)
    progress: Mapped[dict[str, Any]] = mapped_column(_Json)
    error: Mapped[dict[str, Any] | None] = mapped_column(_Json)
    result: Mapped[dict[str, Any] | None] = mapped_column(_Json)
    label: Mapped[str | None] = mapped_column(sa.String(200))
    priority: Mapped[int]
    timeout_s: Mapped[float | None] = mapped_column(_Seconds)
    deadline_s: Mapped[float | None] = mapped_column(_Seconds)
    retry_of: Mapped[str | None] = mapped_column(sa.String(64))
    idempotency_key: Mapped[str | None] = mapped_column(sa.String(255))
    body_digest: Mapped[str | None] = mapped_column(sa.String(71))
    created: Mapped[datetime] = mapped_column(UtcDateTime)
    started: Mapped[datetime | None] = mapped_column(UtcDateTime)
    finished: Mapped[datetime | None] = mapped_column(UtcDateTime)


class ArtefactRow(Base):
    """A file of a finished job."""

    __tablename__ = "artefacts"

    job_id: Mapped[str] = mapped_column(
        sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True
    )
    name: Mapped[str] = mapped_column(sa.String(100), primary_key=True)
    position: Mapped[int]
    size: Mapped[int] = mapped_column(sa.BigInteger)
    media_type: Mapped[str] = mapped_column(sa.String(100))
    digest: Mapped[str] = mapped_column(sa.String(71), index=True)


class EventRow(Base):
    """An entry of a job's history; ids only ever grow."""

    __tablename__ = "events"
    __table_args__ = (
        sa.Index("ix_events_job_id_id", "job_id", "id"),
        {"sqlite_autoincrement": True},
    )

    id: Mapped[int] = mapped_column(_Serial, primary_key=True, autoincrement=True)
    job_id: Mapped[str] = mapped_column(sa.ForeignKey("jobs.id", ondelete="CASCADE"))
    type: Mapped[str] = mapped_column(sa.String(20))
    data: Mapped[dict[str, Any]] = mapped_column(_Json)
    created: Mapped[datetime] = mapped_column(UtcDateTime)


class TaskProgressRow(Base):
    """How far a running task is; its job adds these up and drops them at its end."""

    __tablename__ = "task_progress"

    job_id: Mapped[str] = mapped_column(
        sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True
    )
    stage: Mapped[int] = mapped_column(primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True)
    done: Mapped[float] = mapped_column(_Seconds)
    total: Mapped[float] = mapped_column(_Seconds)
    unit: Mapped[str] = mapped_column(sa.String(40))


class UploadRow(Base):
    """A blob that a project uploaded."""

    __tablename__ = "uploads"

    project: Mapped[str] = mapped_column(sa.String(100), primary_key=True)
    digest: Mapped[str] = mapped_column(sa.String(71), primary_key=True)
    size: Mapped[int] = mapped_column(sa.BigInteger)
    created: Mapped[datetime] = mapped_column(UtcDateTime)


class ResourceRow(Base):
    """A mesh, BRDF or environment: what was asked for and what was understood."""

    __tablename__ = "resources"
    __table_args__ = (sa.Index("ix_resources_project_kind_created", "project", "kind", "created"),)

    id: Mapped[str] = mapped_column(sa.String(64), primary_key=True)
    project: Mapped[str] = mapped_column(sa.String(100))
    kind: Mapped[str] = mapped_column(sa.String(20))
    state: Mapped[str] = mapped_column(sa.String(20))
    label: Mapped[str | None] = mapped_column(sa.String(200))
    request: Mapped[dict[str, Any]] = mapped_column(_Json)
    understood: Mapped[dict[str, Any]] = mapped_column(_Json)
    canonical: Mapped[str | None] = mapped_column(sa.String(71))
    problem: Mapped[dict[str, Any] | None] = mapped_column(_Json)
    created: Mapped[datetime] = mapped_column(UtcDateTime)


class WorkerRow(Base):
    """A worker process and its last heartbeat, by the database's clock."""

    __tablename__ = "workers"

    executor_id: Mapped[str] = mapped_column(sa.String(128), primary_key=True)
    host: Mapped[str] = mapped_column(sa.String(255))
    pid: Mapped[int]
    state: Mapped[str] = mapped_column(sa.String(20))
    tile_slots: Mapped[int]
    started_s: Mapped[float] = mapped_column(_Seconds)
    last_seen_s: Mapped[float] = mapped_column(_Seconds)


class CalibrationRow(Base):
    """Rates of the cost model as a calibration measured them; the newest counts."""

    __tablename__ = "calibrations"

    job_id: Mapped[str] = mapped_column(sa.String(64), primary_key=True)
    seconds: Mapped[dict[str, Any]] = mapped_column(_Json)
    created: Mapped[datetime] = mapped_column(UtcDateTime)


class StageFactorRow(Base):
    """What past jobs say that the rates of a calibration are off by in a stage.

    ``calibration`` is empty for the rates that are shipped.
    """

    __tablename__ = "stage_factors"

    calibration: Mapped[str] = mapped_column(sa.String(64), primary_key=True)
    stage: Mapped[str] = mapped_column(sa.String(40), primary_key=True)
    log_factor: Mapped[float] = mapped_column(_Seconds)
    jobs: Mapped[int]


class ApiKeyRow(Base):
    """An API key; only its hash is kept."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(sa.String(32), primary_key=True)
    hash: Mapped[str] = mapped_column(sa.String(64), unique=True)
    project: Mapped[str] = mapped_column(sa.String(100))
    label: Mapped[str] = mapped_column(sa.String(200))
    created: Mapped[datetime] = mapped_column(UtcDateTime)
    revoked: Mapped[datetime | None] = mapped_column(UtcDateTime)
