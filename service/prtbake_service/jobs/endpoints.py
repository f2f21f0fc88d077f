"""``/v1/jobs``."""

from datetime import timedelta
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Query, Response
from fastapi.responses import StreamingResponse
from starlette.concurrency import run_in_threadpool

from prtbake_service.auth import Caller
from prtbake_service.backend import BackendDep
from prtbake_service.etags import etag_of, none_matches
from prtbake_service.jobs.service import JobService, estimate_from
from prtbake_service.jobs.stream import is_over, stream_events
from prtbake_service.waiting import preferred_wait, wait_until
from prtbake_storage.contract.base import Label, Moment
from prtbake_storage.contract.jobs import Estimate, Job, JobKind, JobPage, JobRequest, JobState

router = APIRouter(prefix="/v1", tags=["jobs"])
RETRY_AFTER = {"Retry-After": "1"}
JobId = Annotated[str, Path(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
ChosenId = Annotated[str, Path(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
IdempotencyKey = Annotated[str | None, Header(min_length=1, max_length=255)]
PAGE = 20
PAGE_MAX = 100


def job_service(backend: BackendDep, caller: Caller) -> JobService:
    """Return the service for the caller's project."""
    return JobService(backend, caller.project)


ServiceDep = Annotated[JobService, Depends(job_service)]


@router.post("/jobs", status_code=202, responses={200: {"model": Job}})
def submit(
    request: JobRequest,
    service: ServiceDep,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Submit a job; the same ``Idempotency-Key`` with the same body gives the same job."""
    job, is_new = service.submit(request, idempotency_key=idempotency_key)
    return _accepted(job, is_new, response)


@router.put("/jobs/{job_id}", status_code=202, responses={200: {"model": Job}})
def submit_as(
    job_id: ChosenId, request: JobRequest, service: ServiceDep, response: Response
) -> Job:
    """Submit a job under an id of the caller's choice; repeating it gives the same job."""
    job, is_new = service.submit(request, job_id=job_id)
    return _accepted(job, is_new, response)


@router.post("/jobs:estimate", responses={200: {"model": Estimate}, 202: {"model": Job}})
async def estimate(
    request: JobRequest,
    service: ServiceDep,
    backend: BackendDep,
    prefer: Annotated[str | None, Header(max_length=200)] = None,
) -> Response:
    """Validate, plan and predict without running; 202 with the quick job if that takes longer."""
    job = await run_in_threadpool(service.estimate, request)
    job = await wait_until(
        lambda: service.get(job.id),
        lambda found: found.state.terminal,
        closing=backend.closing,
        at_most=preferred_wait(prefer, backend.settings),
        every=backend.settings.poll_every,
    )
    if job.state.terminal:
        return _json(estimate_from(job).model_dump_json().encode())
    headers = {"Location": f"/v1/jobs/{job.id}"} | RETRY_AFTER
    return _json(job.model_dump_json().encode(), 202, headers)


@router.get("/jobs")
def list_jobs(
    backend: BackendDep,
    caller: Caller,
    *,
    state: Annotated[list[JobState] | None, Query(description="repeat for several")] = None,
    kind: Annotated[list[JobKind] | None, Query(description="repeat for several")] = None,
    label: Annotated[Label | None, Query()] = None,
    created_after: Moment | None = None,
    created_before: Moment | None = None,
    cursor: Annotated[str | None, Query(max_length=300)] = None,
    limit: Annotated[int, Query(ge=1, le=PAGE_MAX)] = PAGE,
) -> JobPage:
    """List jobs, newest first; filters are combined by *and*."""
    return backend.jobs.page(
        project=caller.project,
        states=state or (),
        kinds=kind or (),
        label=label,
        created_after=created_after,
        created_before=created_before,
        cursor=cursor,
        limit=limit,
    )


@router.get("/jobs/{job_id}", responses={200: {"model": Job}, 304: {"description": "as known"}})
async def get_job(
    job_id: JobId,
    service: ServiceDep,
    backend: BackendDep,
    *,
    wait: Annotated[float, Query(ge=0, description="seconds to wait for a change")] = 0.0,
    if_none_match: Annotated[str | None, Header()] = None,
) -> Response:
    """Read a job.

    With ``wait`` and ``If-None-Match`` the answer comes when the job has changed, with ``wait``
    alone when it has ended, and in any case after that time.
    """

    def changed(job: Job) -> bool:
        if if_none_match is None:
            return job.state.terminal
        return not none_matches(if_none_match, etag_of(job.model_dump_json().encode()))

    job = await wait_until(
        lambda: service.get(job_id),
        changed,
        closing=backend.closing,
        at_most=min(timedelta(seconds=min(wait, 3600.0)), backend.settings.long_poll_max),
        every=backend.settings.poll_every,
    )
    body = job.model_dump_json().encode()
    headers = {"ETag": etag_of(body), "Cache-Control": "private, no-cache"}
    if none_matches(if_none_match, headers["ETag"]):
        return Response(status_code=304, headers=headers)
    return _json(body, headers=headers)


@router.get(
    "/jobs/{job_id}/events",
    response_class=StreamingResponse,
    responses={
        200: {"content": {"text/event-stream": {}}},
        204: {"description": "the job has ended and all was told"},
    },
)
async def job_events(
    job_id: JobId,
    service: ServiceDep,
    backend: BackendDep,
    *,
    follow: Annotated[bool, Query(description="go on until the job ends")] = True,
    last_event_id: Annotated[int | None, Header(ge=0, lt=2**63)] = None,
) -> Response:
    """Follow a job: its whole history or what came after ``Last-Event-ID``, then what comes."""
    await run_in_threadpool(service.get, job_id)
    after = last_event_id or 0
    if await run_in_threadpool(is_over, backend, job_id, after):
        # an EventSource that is told 204 stops connecting again
        return Response(status_code=204)
    return StreamingResponse(
        stream_events(backend, job_id, after, follow=follow),
        media_type="text/event-stream",
        # no proxy may hold events back to compress or buffer them
        headers={"Cache-Control": "no-store, no-transform", "X-Accel-Buffering": "no"},
    )


@router.post("/jobs/{job_id}/cancel", status_code=202)
def cancel(job_id: JobId, service: ServiceDep, response: Response) -> Job:
    """Ask for a job to stop; asking again, or too late, changes nothing."""
    response.headers.update(RETRY_AFTER)
    return service.cancel(job_id)


@router.post("/jobs/{job_id}/retry", status_code=202, responses={200: {"model": Job}})
def retry(
    job_id: JobId,
    service: ServiceDep,
    response: Response,
    idempotency_key: IdempotencyKey = None,
) -> Job:
    """Make a new job that goes on from the last finished tile of one that did not succeed."""
    job, is_new = service.retry(job_id, idempotency_key=idempotency_key)
    return _accepted(job, is_new, response)


@router.delete("/jobs/{job_id}", status_code=204)
def delete(job_id: JobId, service: ServiceDep) -> None:
    """Remove a job that has ended; files that nothing else refers to are collected later."""
    service.delete(job_id)


def _accepted(job: Job, is_new: bool, response: Response) -> Job:
    response.status_code = 202 if is_new else 200
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    if is_new:
        response.headers.update(RETRY_AFTER)
    return job


def _json(body: bytes, status: int = 200, headers: dict[str, str] | None = None) -> Response:
    return Response(body, status, headers, media_type="application/json")
