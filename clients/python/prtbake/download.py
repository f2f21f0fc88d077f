"""The receiving end of a download: resumes, checks the digest, then shows the file.

Bytes go to ``NAME.part`` beside the target.  What is there from an earlier try is kept and asked
for no more; the file gets its name only once its digest is right.
"""

import hashlib
import os
import re
from pathlib import Path
from typing import IO

import httpx

from prtbake.errors import DownloadError
from prtbake.files import CHUNK_BYTES, file_digest
from prtbake_storage.contract.jobs import Artefact

_CONTENT_RANGE = re.compile(r"bytes (\d+)-(\d+)/(\d+)")


class PartialFile:
    """A file that arrives in one or more pieces.

    Parameters
    ----------
    artefact
        What is expected: name, size in bytes and digest.
    folder
        Where the file goes; made if it is not there.
    """

    def __init__(self, artefact: Artefact, folder: Path) -> None:
        if Path(artefact.name).name != artefact.name or artefact.name in {"", ".", ".."}:
            raise DownloadError(f"{artefact.name!r} is not a plain file name")
        self.artefact = artefact
        self.target = folder / artefact.name
        self.part = folder / f"{artefact.name}.part"
        self._file: IO[bytes] | None = None
        folder.mkdir(parents=True, exist_ok=True)
        self.received = self.part.stat().st_size if self.part.exists() else 0
        if self.received > artefact.size:
            self.restart()

    @property
    def arrived(self) -> bool:
        """Whether the target is there already with the right bytes."""
        return (
            self.target.is_file()
            and self.target.stat().st_size == self.artefact.size
            and file_digest(self.target) == self.artefact.sha256
        )

    @property
    def complete(self) -> bool:
        """Whether all bytes are here, right or wrong."""
        return self.received == self.artefact.size

    def headers(self) -> dict[str, str]:
        """Return the headers that ask for what is missing."""
        # identity: a range of a compressed stream is not a range of the file
        asked = {"Accept-Encoding": "identity"}
        if self.received:
            asked["Range"] = f"bytes={self.received}-"
            asked["If-Range"] = f'"{self.artefact.sha256}"'
        return asked

    def begin(self, response: httpx.Response) -> None:
        """Get ready for the body of a 200 (from the start), 206 (from an offset) or 416."""
        if response.status_code == 206:
            match = _CONTENT_RANGE.fullmatch(response.headers.get("content-range", ""))
            if match is None or int(match[1]) != self.received:
                self.restart()
                raise DownloadError(f"{self.artefact.name}: the service sent another range")
        else:
            self.restart()
        self._file = self.part.open("ab", buffering=CHUNK_BYTES)

    def write(self, chunk: bytes) -> int:
        """Append bytes; return their count."""
        if self._file is None:
            raise RuntimeError("begin() comes first")
        self._file.write(chunk)
        self.received += len(chunk)
        if self.received > self.artefact.size:
            raise DownloadError(f"{self.artefact.name}: more than {self.artefact.size} bytes came")
        return len(chunk)

    def pause(self) -> None:
        """Put what has come on disk."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def restart(self) -> None:
        """Forget what has come."""
        self.pause()
        self.part.unlink(missing_ok=True)
        self.received = 0

    def finish(self) -> Path:
        """Check the digest and give the file its name.

        Raises
        ------
        DownloadError
            When the bytes are not those the digest names; they are thrown away.
        """
        self.pause()
        with self.part.open("ab+") as file:
            file.seek(0)
            digest = f"sha256:{hashlib.file_digest(file, 'sha256').hexdigest()}"
            os.fsync(file.fileno())
        if digest != self.artefact.sha256:
            self.restart()
            raise DownloadError(
                f"{self.artefact.name}: the bytes have digest {digest}, "
                f"the manifest says {self.artefact.sha256}"
            )
        self.part.replace(self.target)
        return self.target
