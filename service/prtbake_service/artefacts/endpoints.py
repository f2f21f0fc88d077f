"""``/v1/jobs/{id}/artefacts``."""

from typing import Annotated

from fastapi import APIRouter, Header, Path, Response
from fastapi.responses import StreamingResponse

from prtbake_service.artefacts.ranges import RangeNotSatisfiable, parse_range
from prtbake_service.artefacts.service import FileResponse, find
from prtbake_service.auth import Caller
from prtbake_service.backend import BackendDep
from prtbake_service.errors_http import CODES, problem_response, title_of
from prtbake_service.etags import none_matches
from prtbake_service.jobs.endpoints import JobId
from prtbake_storage.contract.jobs import ArtefactManifest, Problem

router = APIRouter(prefix="/v1/jobs/{job_id}/artefacts", tags=["artefacts"])
Name = Annotated[str, Path(pattern=r"^[a-z0-9_.-]{1,100}$")]
HeaderText = Annotated[str | None, Header()]


@router.get("")
def list_artefacts(job_id: JobId, backend: BackendDep, caller: Caller) -> ArtefactManifest:
    """List the files of a job: name, size, media type, digest."""
    return ArtefactManifest(items=backend.jobs.get(job_id, project=caller.project).artefacts)


@router.get(
    "/{name}",
    response_class=StreamingResponse,
    responses={
        200: {"content": {"application/octet-stream": {}}},
        206: {"description": "the range that was asked for"},
        304: {"description": "as known"},
        416: {"model": Problem, "description": "no byte lies in the range"},
    },
)
def download(
    job_id: JobId,
    name: Name,
    backend: BackendDep,
    caller: Caller,
    *,
    range_: Annotated[str | None, Header(alias="Range")] = None,
    if_range: HeaderText = None,
    if_none_match: HeaderText = None,
) -> Response:
    """Download a file or one range of it; it never changes."""
    found = find(backend, caller.project, job_id, name)
    artefact = found.artefact
    if none_matches(if_none_match, found.etag):
        headers = {"ETag": found.etag, "Cache-Control": found.headers(None)["Cache-Control"]}
        return Response(status_code=304, headers=headers)
    try:
        # another version than the caller has begun with: the whole file again
        changed = if_range is not None and if_range != found.etag
        part = None if changed else parse_range(range_, artefact.size)
    except RangeNotSatisfiable:
        problem = Problem(
            title=title_of(416),
            status=416,
            detail=f"{name} has {artefact.size} bytes; none lies in {range_}",
            code=CODES[416],
        )
        return problem_response(problem, {"Content-Range": f"bytes */{artefact.size}"})
    start, length = (0, artefact.size) if part is None else (part.start, part.length)
    return FileResponse(
        backend.blobs.open(artefact.sha256),
        start,
        length,
        status=200 if part is None else 206,
        headers=found.headers(part),
        media_type=artefact.media_type,
    )


@router.head("/{name}", include_in_schema=False)
def describe(job_id: JobId, name: Name, backend: BackendDep, caller: Caller) -> Response:
    """Give the headers of a download without its bytes."""
    found = find(backend, caller.project, job_id, name)
    return Response(headers=found.headers(None), media_type=found.artefact.media_type)
