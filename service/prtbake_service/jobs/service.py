"""What can be done with jobs."""

import logging
import secrets
from typing import Any, get_args

from pydantic import ValidationError

from prtbake_service.backend import Backend
from prtbake_service.errors_http import ProblemError
from prtbake_service.jobs.references import Resolver
from prtbake_service.validation import validation_entries
from prtbake_storage.blobs.base import json_digest
from prtbake_storage.contract.jobs import (
    AnyRequest,
    Estimate,
    Job,
    JobKind,
    JobState,
    job_request_adapter,
)
from prtbake_storage.errors import Conflict, InputError, PrtError, TooLarge
from prtbake_storage.queue.failures import CPU_LIMIT, OUT_OF_MEMORY
from prtbake_storage.records import NewJob

log = logging.getLogger(__name__)
STATUS_OF_KIND = {"input": 400, "resource": 503, "internal": 500}
OVER_LIMIT = frozenset({CPU_LIMIT, OUT_OF_MEMORY, TooLarge.code})
"""Codes that say 413 where the fault is the input's: a 503 would invite to try the same again."""
PARSE_PREFIX = "parse-"
ESTIMATE_PRIORITY = 10  # a person waits for it; lower is sooner
QUICK_TIMEOUT_S = 600.0
"""Longest run of an estimate or a parsing: their CPU time is limited to half of it."""


class JobService:
    """The jobs of one project."""

    def __init__(self, backend: Backend, project: str) -> None:
        self._backend = backend
        self._project = project
        self._resolver = Resolver(backend, project)

    def get(self, job_id: str) -> Job:
        """Look a job up."""
        return self._backend.jobs.get(job_id, project=self._project)

    def submit(
        self,
        request: AnyRequest,
        *,
        job_id: str | None = None,
        idempotency_key: str | None = None,
        retry_of: str | None = None,
    ) -> tuple[Job, bool]:
        """Make a job, or find the one that the same id or key made; tell whether it is new."""
        if job_id is not None and job_id.startswith(PARSE_PREFIX):
            raise InputError(f"job ids that start with {PARSE_PREFIX} are the service's own")
        body = request.model_dump(mode="json")
        # what the client gave: a later version has other fields and defaults beside it
        identity = {
            "request": request.model_dump(mode="json", exclude_unset=True),
            "retry_of": retry_of,
        }
        digest = f"sha256:{json_digest(identity)}"
        # before the references are looked at: what they name may be gone by now
        known = self._backend.jobs.earlier(
            project=self._project,
            job_id=job_id,
            idempotency_key=idempotency_key,
            body_digest=digest,
            same=lambda job: job.retry_of == retry_of and spelled_out(job.request) == body,
        )
        if known is not None:
            return known, False
        return self._create(
            NewJob(
                id=job_id or new_id(request.kind),
                kind=request.kind,
                request=body,
                context=self._resolver.resolve(request) | self._machine(request),
                project=self._project,
                label=request.label,
                priority=request.priority,
                timeout_s=request.timeout_s,
                retry_of=retry_of,
                idempotency_key=idempotency_key,
                body_digest=digest,
            )
        )

    def _machine(self, request: AnyRequest) -> dict[str, Any]:
        """Tell what work takes here; a job with a time to keep also asks how many share it."""
        rates = {"rates": self._backend.rates.current()}
        if getattr(request, "budget", None) is not None:
            return rates | {"tile_slots": self._backend.tile_slots()}
        return rates

    def estimate(self, request: AnyRequest) -> Job:
        """Start the quick job that plans and predicts."""
        job, _ = self._create(
            NewJob(
                id=new_id("estimate"),
                kind="estimate",
                request={"request": request.model_dump(mode="json")},
                context=self._resolver.resolve(request)
                | {
                    "rates": self._backend.rates.current(),
                    "tile_slots": self._backend.tile_slots(),
                },
                project=self._project,
                internal=True,
                quick=True,
                priority=ESTIMATE_PRIORITY,
                timeout_s=QUICK_TIMEOUT_S,
            )
        )
        return job

    def retry(self, job_id: str, *, idempotency_key: str | None = None) -> tuple[Job, bool]:
        """Make a new job from one that ended badly; finished tiles are found again."""
        old = self.get(job_id)
        if old.kind not in get_args(JobKind):
            raise Conflict(f"job {job_id} is the service's own: register or estimate anew")
        if not old.state.terminal or old.state is JobState.succeeded:
            raise Conflict(
                f"job {job_id} is {old.state}: only failed, canceled and expired jobs"
                " can be tried again"
            )
        try:
            request = job_request_adapter.validate_python(old.request)
        except ValidationError as error:  # an earlier version took it
            entries = validation_entries(error.errors(), old.request)
            detail = f"the request of job {job_id} is not taken any more: {entries[0]['detail']}"
            raise Conflict(detail, pointer=entries[0]["pointer"]) from error
        return self.submit(request, idempotency_key=idempotency_key, retry_of=job_id)

    def cancel(self, job_id: str) -> Job:
        """Ask for a job to stop."""
        job = self._backend.jobs.request_cancel(job_id, project=self._project)
        if job.state is JobState.canceled:
            # a worker that runs it sees the row; one that is only queued need not even be taken
            try:
                self._backend.queue.cancel([job_id])
            except Exception:
                log.exception("job.cancel.engine", extra={"job_id": job_id})
        return job

    def delete(self, job_id: str) -> None:
        """Remove the rows of a job that has ended.

        Its blobs stay: a running job may have recalled them.  The workers' garbage collector takes
        those that nothing refers to once they are old enough.
        """
        self._backend.jobs.delete(job_id, project=self._project)
        try:
            self._backend.queue.forget(job_id)
        except Exception:
            log.exception("job.forget.engine", extra={"job_id": job_id})

    def _create(self, new: NewJob) -> tuple[Job, bool]:
        job, is_new = self._backend.jobs.create(new)
        if is_new:
            enqueue(self._backend, new)
        return job, is_new


def spelled_out(stored: dict[str, Any]) -> dict[str, Any] | None:
    """Give a stored request as this version spells it out; None where it takes it no more.

    Digests that earlier versions made are of requests as these spelled them out.
    """
    try:
        return job_request_adapter.validate_python(stored).model_dump(mode="json")
    except ValidationError:
        return None


def enqueue(backend: Backend, new: NewJob) -> None:
    """Give a committed job to the engine; if that fails, the reconciler does it later."""
    try:
        backend.queue.submit(new.id, quick=new.quick, priority=new.priority)
    except Exception:
        log.exception("job.enqueue.failed", extra={"job_id": new.id})
    else:
        log.info("job.submitted", extra={"job_id": new.id, "kind": new.kind})


def estimate_from(job: Job) -> Estimate:
    """Read the estimate that a quick job came to, or raise what it failed with."""
    if job.state is JobState.succeeded:
        return Estimate.model_validate(job.result)
    raise failure_of(job)


def failure_of(job: Job) -> PrtError:
    """Return the error of a quick job that did not succeed."""
    if job.error is None:
        return ProblemError(500, "internal", f"the quick job {job.id} was {job.state}")
    error = job.error
    status = status_of(error.kind, error.code)
    return ProblemError(status, error.code, error.detail, pointer=error.pointer)


def status_of(kind: str, code: str) -> int:
    """Return the HTTP status of a quick job's error."""
    if kind == "input" and code in OVER_LIMIT:
        return TooLarge.http_status
    return STATUS_OF_KIND.get(kind, 500)


def new_id(kind: str) -> str:
    """Return a fresh id that says what the job is."""
    return f"{kind}-{secrets.token_hex(8)}"
