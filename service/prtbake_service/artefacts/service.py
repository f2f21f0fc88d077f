"""A file of a job as an HTTP representation."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from prtbake_service.artefacts.ranges import ByteRange
from prtbake_service.backend import Backend
from prtbake_storage.contract.jobs import Artefact
from prtbake_storage.errors import NotFound

CHUNK_BYTES = 1 << 18  # 256 KiB
FOREVER = "private, max-age=31536000, immutable"


@dataclass(frozen=True)
class Representation:
    """An artefact and the headers that describe it."""

    artefact: Artefact

    @property
    def etag(self) -> str:
        """The strong entity tag: the digest itself."""
        return f'"{self.artefact.sha256}"'

    @property
    def digest(self) -> str:
        """The digest as RFC 9530 writes it."""
        raw = bytes.fromhex(self.artefact.sha256.removeprefix("sha256:"))
        return f"sha-256=:{base64.b64encode(raw).decode()}:"

    def headers(self, part: ByteRange | None) -> dict[str, str]:
        """Return the headers of a whole answer or of a part."""
        headers = {
            "Accept-Ranges": "bytes",
            "ETag": self.etag,
            "Repr-Digest": self.digest,
            "Cache-Control": FOREVER,
            # names are [a-z0-9_.-] by contract: nothing to escape
            "Content-Disposition": f'attachment; filename="{self.artefact.name}"',
            # a report is a web page: opened here, it may run nothing in this origin
            "Content-Security-Policy": "sandbox",
            "Content-Length": str(self.artefact.size if part is None else part.length),
        }
        if part is None:
            headers["Content-Digest"] = self.digest
        else:
            headers["Content-Range"] = part.content_range
        return headers


def find(backend: Backend, project: str, job_id: str, name: str) -> Representation:
    """Find a file of a job."""
    for artefact in backend.jobs.get(job_id, project=project).artefacts:
        if artefact.name == name:
            return Representation(artefact)
    raise NotFound(f"job {job_id} has no artefact {name}")


class FileResponse(StreamingResponse):
    """Stream a part of an open file, and close it however the sending ends."""

    def __init__(
        self,
        file: BinaryIO,
        start: int,
        length: int,
        *,
        status: int,
        headers: dict[str, str],
        media_type: str,
    ) -> None:
        super().__init__(
            _pieces(file, start, length), status, headers=headers, media_type=media_type
        )
        self._file = file

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send; a caller that hangs up leaves the iterator behind, not the file."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._file.close()


def _pieces(file: BinaryIO, start: int, length: int) -> Iterator[bytes]:
    file.seek(start)
    while length > 0 and (chunk := file.read(min(CHUNK_BYTES, length))):
        length -= len(chunk)
        yield chunk
