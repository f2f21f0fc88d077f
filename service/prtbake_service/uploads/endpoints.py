"""``/v1/uploads``."""

from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Request, Response
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect

from prtbake_service.auth import Caller
from prtbake_service.backend import BackendDep
from prtbake_service.errors_http import ProblemError
from prtbake_service.uploads.service import UploadService
from prtbake_storage.contract.resources import MissingRequest, MissingResponse, Upload

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])
DigestPath = Annotated[str, Path(pattern=r"^sha256:[0-9a-f]{64}$")]
_BINARY = {
    "requestBody": {
        "required": True,
        "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
    }
}


def upload_service(backend: BackendDep, caller: Caller) -> UploadService:
    """Return the service for the caller's project."""
    return UploadService(backend, caller.project)


ServiceDep = Annotated[UploadService, Depends(upload_service)]


@router.post("/missing")
def missing(request: MissingRequest, service: ServiceDep) -> MissingResponse:
    """Tell which of some blobs have yet to be uploaded."""
    return MissingResponse(missing=service.missing(request.digests))


@router.put("/{digest}", status_code=201, responses={200: {"model": Upload}}, openapi_extra=_BINARY)
async def upload(
    digest: DigestPath,
    request: Request,
    service: ServiceDep,
    response: Response,
    content_length: Annotated[int | None, Header(ge=0)] = None,
) -> Upload:
    """Store the body under its digest: 201 when it is new, 200 when it is known."""
    known = await run_in_threadpool(service.known, digest)
    if known is not None:
        response.status_code = 200
        return known
    try:
        return await service.store(digest, content_length, request.stream())
    except ClientDisconnect as error:
        # nobody reads this answer; it keeps a vanished caller out of the error log
        raise ProblemError(400, "incomplete", "the upload broke off") from error


@router.get("/{digest}")
def get_upload(digest: DigestPath, backend: BackendDep, caller: Caller) -> Upload:
    """Tell what is known of an upload."""
    return backend.uploads.get(digest, project=caller.project)
