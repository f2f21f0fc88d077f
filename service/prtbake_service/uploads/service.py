"""Taking bytes in under their digest."""

from collections.abc import AsyncIterator

from starlette.concurrency import run_in_threadpool

from prtbake_service.backend import Backend
from prtbake_storage.contract.resources import Upload
from prtbake_storage.errors import NotFound, TooLarge

BATCH_BYTES = 1 << 20  # 1 MiB a turn of the thread pool: a turn costs about 0.1 ms


class UploadService:
    """The uploads of one project."""

    def __init__(self, backend: Backend, project: str) -> None:
        self._backend = backend
        self._project = project

    def missing(self, digests: list[str]) -> list[str]:
        """Return those that the project has yet to upload, in the order given."""
        unknown = set(self._backend.uploads.missing(digests, project=self._project))
        return [
            digest
            for digest in dict.fromkeys(digests)
            if digest in unknown or not self._backend.blobs.exists(digest)
        ]

    def known(self, digest: str) -> Upload | None:
        """Return an upload that the project made before."""
        try:
            upload = self._backend.uploads.get(digest, project=self._project)
        except NotFound:
            return None
        return upload if self._backend.blobs.exists(digest) else None

    async def store(self, digest: str, declared: int | None, body: AsyncIterator[bytes]) -> Upload:
        """Store a body while it comes in.

        Bytes that another project has uploaded must be sent all the same: knowing a digest gives
        no right to what it names.

        Raises
        ------
        TooLarge
            Before anything is read if the declared size says so, else when the limit is passed.
        DigestMismatch
            When the bytes are not those that the digest names; nothing is kept.
        """
        limit = self._backend.settings.max_upload_bytes
        if declared is not None and declared > limit:
            raise TooLarge(f"the upload has {declared} bytes; {limit} are allowed")
        with self._backend.blobs.writer(max_bytes=limit) as writer:
            batch = bytearray()
            async for chunk in body:
                batch += chunk
                if len(batch) >= BATCH_BYTES:
                    await run_in_threadpool(writer.write, bytes(batch))
                    batch.clear()
            await run_in_threadpool(writer.write, bytes(batch))
            size = writer.size
            await run_in_threadpool(writer.commit, digest)
        await run_in_threadpool(self._backend.uploads.add, digest, size, project=self._project)
        return Upload(digest=digest, size=size)
