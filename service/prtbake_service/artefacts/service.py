"""A file of a job as an HTTP representation."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO

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


def read_bytes(file: BinaryIO, start: int, length: int) -> Iterator[bytes]:
    """Read a part of an open file piece by piece, and close it."""
    with file:
        file.seek(start)
        while length > 0 and (chunk := file.read(min(CHUNK_BYTES, length))):
            length -= len(chunk)
            yield chunk
