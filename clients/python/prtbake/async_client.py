"""The asynchronous client: the same methods, awaited."""

import time
from collections.abc import AsyncIterator
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

import anyio
import httpx
from anyio import to_thread

from prtbake import calls
from prtbake.client import OnBytes
from prtbake.config import discover
from prtbake.download import PartialFile
from prtbake.errors import JobNotSucceeded, ServiceFailed, ServiceUnreachable, WaitTimeout
from prtbake.files import chunks_async, file_digest
from prtbake.outcome import estimate_of, job_of_estimate, parsed
from prtbake.retrying import (
    LONG_POLL_S,
    REGISTER_S,
    STREAM_SILENCE_S,
    Patience,
    check,
    client_options,
    pause_after,
    pauses,
    request_options,
    unreachable,
)
from prtbake.sse import EventReader
from prtbake_storage.contract.jobs import Artefact, Estimate, Event, Job, JobPage, JobState
from prtbake_storage.contract.resources import (
    BrdfRegistration,
    EnvironmentRegistration,
    MeshRegistration,
    Resource,
    Upload,
)

T = TypeVar("T")


class AsyncClient:
    """Talk to a prtbake service from an event loop; parameters as for `prtbake.Client`.

    A local service must be ready: `prtbake.Client` waits for one that is starting.
    """

    def __init__(
        self,
        url: str | None = None,
        *,
        key: str | None = None,
        data_dir: Path | None = None,
        timeout_s: float = 30.0,
        retries: int = 2,
        transport: httpx.AsyncBaseTransport | None = None,
    ) -> None:
        # waiting for a local service that is starting would hold the event loop up
        endpoint = discover(url, key, data_dir, grace_s=0.0, start_s=0.0)
        self.url = endpoint.url
        self._timeout_s = timeout_s
        self._retries = retries
        self._http = httpx.AsyncClient(
            transport=transport, **client_options(endpoint.url, endpoint.key, timeout_s)
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections."""
        await self._http.aclose()

    # jobs

    async def submit(
        self,
        request: calls.JobSpec,
        *,
        job_id: str | None = None,
        idempotency_key: str | None = None,
    ) -> Job:
        """Submit a job; the same key or id with the same request gives the same job."""
        return await self._send(
            calls.submit_job(request, job_id=job_id, idempotency_key=idempotency_key)
        )

    async def estimate(self, request: calls.JobSpec) -> Estimate:
        """Say what a job would do and cost, without running it."""
        response = await self._send(calls.estimate_job(request), extra_s=LONG_POLL_S)
        if response.status_code == 200:
            return calls.read_estimate(response)
        return estimate_of(await self.wait(job_of_estimate(response)))

    async def job(self, job_id: str) -> Job:
        """Read a job."""
        job, _ = await self._send(calls.get_job(job_id))
        if job is None:
            raise RuntimeError("304 without having asked for it")
        return job

    async def page(
        self,
        *,
        state: list[str] | None = None,
        kind: str | None = None,
        label: str | None = None,
        cursor: str | None = None,
        limit: int | None = None,
    ) -> JobPage:
        """Read one page of jobs, newest first."""
        return await self._send(
            calls.list_jobs(state=state, kind=kind, label=label, cursor=cursor, limit=limit)
        )

    async def jobs(
        self, *, state: list[str] | None = None, kind: str | None = None, label: str | None = None
    ) -> AsyncIterator[Job]:
        """Walk all jobs, newest first, page by page."""
        cursor: str | None = None
        while True:
            page = await self.page(state=state, kind=kind, label=label, cursor=cursor)
            for job in page.items:
                yield job
            cursor = page.next
            if cursor is None:
                return

    async def follow(self, job_id: str, *, timeout_s: float | None = None) -> AsyncIterator[Job]:
        """Yield the job now and whenever it changes, until it has ended; see `Client.follow`."""
        start = time.monotonic()
        job, etag = await self._send(calls.get_job(job_id))
        if job is None:
            raise RuntimeError("304 without having asked for it")
        yield job
        patience = Patience(None if timeout_s is None else start + timeout_s)
        while not job.state.terminal:
            left = LONG_POLL_S
            if timeout_s is not None:
                left = min(left, start + timeout_s - time.monotonic())
                if left <= 0:
                    raise WaitTimeout(job, timeout_s)
            call = calls.get_job(job_id, wait_s=round(left, 3), etag=etag)
            try:
                changed, etag = await self._send(call, extra_s=left)
            except (ServiceUnreachable, ServiceFailed):
                if (pause := patience.pause()) is None:
                    raise
                await anyio.sleep(pause)
                continue
            patience.answered()
            if changed is not None:
                job = changed
                yield job

    async def wait(self, job_id: str, *, timeout_s: float | None = None, check: bool = True) -> Job:
        """Wait for a job to end; raises as `Client.wait` does."""
        last = None
        async for job in self.follow(job_id, timeout_s=timeout_s):
            last = job
        if last is None:
            raise RuntimeError("a job that is followed shows at least once")
        if check and last.state is not JobState.succeeded:
            raise JobNotSucceeded(last)
        return last

    async def events(
        self, job_id: str, *, after: int | None = None, follow: bool = True
    ) -> AsyncIterator[Event]:
        """Yield the job's events from the first (or from ``after``) to its end."""
        reader = EventReader(after)
        patience = Patience()
        while True:
            try:
                async with self._http.stream(
                    "GET",
                    f"/v1/jobs/{job_id}/events",
                    headers=reader.headers(),
                    params={"follow": follow},
                    timeout=httpx.Timeout(self._timeout_s, read=STREAM_SILENCE_S),
                ) as response:
                    if response.is_error:
                        await response.aread()
                        check(response)
                    if response.status_code == 204:
                        return
                    async for line in response.aiter_lines():
                        patience.answered()
                        if (event := reader.feed(line)) is not None:
                            yield event
                    if not follow:
                        return
            except (httpx.TransportError, ServiceFailed) as error:
                if (pause := patience.pause()) is None:
                    if isinstance(error, httpx.TransportError):
                        raise unreachable(self.url, error) from error
                    raise
                await anyio.sleep(pause)

    async def cancel(self, job_id: str) -> Job:
        """Ask for a job to stop; doing so twice, or after its end, changes nothing."""
        return await self._send(calls.cancel_job(job_id))

    async def retry(self, job_id: str) -> Job:
        """Start a new job that goes on from the last finished tile of one that did not succeed."""
        return await self._send(calls.retry_job(job_id))

    async def delete(self, job_id: str) -> None:
        """Remove a job that has ended, and its artefacts."""
        await self._send(calls.delete_job(job_id))

    # files down

    async def artefacts(self, job_id: str) -> list[Artefact]:
        """Read the manifest of a job's files."""
        return await self._send(calls.list_artefacts(job_id))

    async def download(
        self,
        job_id: str,
        artefact: Artefact | str,
        folder: Path,
        *,
        on_bytes: OnBytes | None = None,
    ) -> Path:
        """Download one file, going on where an earlier try stopped; return its path."""
        if isinstance(artefact, str):
            artefact = await self._artefact(job_id, artefact)
        partial = PartialFile(artefact, folder)
        if await to_thread.run_sync(lambda: partial.arrived):
            return partial.target
        for pause in pauses(self._retries):
            try:
                await self._receive(job_id, partial, on_bytes)
            except httpx.TransportError as error:
                if pause is None:
                    raise unreachable(self.url, error) from error
                await anyio.sleep(pause)
            if partial.complete:
                break
        return await to_thread.run_sync(partial.finish)

    async def download_all(
        self, job_id: str, folder: Path, *, on_bytes: OnBytes | None = None
    ) -> list[Path]:
        """Download every file of a job."""
        return [
            await self.download(job_id, item, folder, on_bytes=on_bytes)
            for item in await self.artefacts(job_id)
        ]

    # files up

    async def upload(self, path: Path, *, on_bytes: OnBytes | None = None) -> Upload:
        """Upload a file unless the service holds its bytes already."""
        digest = await to_thread.run_sync(file_digest, path)
        size = path.stat().st_size
        if not (await self._send(calls.missing_uploads([digest]))).missing:
            return Upload(digest=digest, size=size)

        async def counted() -> AsyncIterator[bytes]:
            async for chunk in chunks_async(path):
                yield chunk
                if on_bytes is not None:
                    on_bytes(len(chunk))

        try:
            response = await self._http.put(
                f"/v1/uploads/{digest}", content=counted(), headers={"Content-Length": str(size)}
            )
        except httpx.TransportError as error:
            raise unreachable(self.url, error) from error
        check(response)
        return calls.read_upload(response)

    async def register(
        self, registration: calls.Registration, *, timeout_s: float = REGISTER_S
    ) -> Resource:
        """Have a mesh, BRDF or environment parsed; return what was understood."""
        start = time.monotonic()
        resource = await self._send(calls.register(registration), extra_s=LONG_POLL_S)
        while resource.state == "parsing":
            left = min(LONG_POLL_S, start + timeout_s - time.monotonic())
            if left <= 0:
                raise WaitTimeout(resource, timeout_s)
            call = calls.get_resource(resource.id, wait_s=round(left, 3))
            resource = await self._send(call, extra_s=left)
        return parsed(resource)

    async def resource(self, resource_id: str) -> Resource:
        """Read a mesh, BRDF or environment."""
        return await self._send(calls.get_resource(resource_id))

    async def add_mesh(self, path: Path, **options: object) -> Resource:
        """Upload a mesh file and register it; options are those of ``MeshRegistration``."""
        upload = await self.upload(path)
        body = {"blob": upload.digest, "filename": path.name, **options}
        return await self.register(MeshRegistration.model_validate(body))

    async def add_brdf(self, path: Path, **options: object) -> Resource:
        """Upload a BRDF file and register it; options are those of ``BrdfRegistration``."""
        upload = await self.upload(path)
        body = {"blob": upload.digest, "filename": path.name, **options}
        return await self.register(BrdfRegistration.model_validate(body))

    async def add_environment(self, path: Path, **options: object) -> Resource:
        """Upload an HDR picture and register it; options: ``EnvironmentRegistration``."""
        upload = await self.upload(path)
        body = {"blob": upload.digest, "filename": path.name, **options}
        return await self.register(EnvironmentRegistration.model_validate(body))

    # the wire

    async def _artefact(self, job_id: str, name: str) -> Artefact:
        for item in await self.artefacts(job_id):
            if item.name == name:
                return item
        # let the service say it, in its own words and with its code
        check(await self._http.get(calls.artefact_path(job_id, name)))
        raise LookupError(name)

    async def _receive(self, job_id: str, partial: PartialFile, on_bytes: OnBytes | None) -> None:
        if partial.complete:
            return
        path = calls.artefact_path(job_id, partial.artefact.name)
        async with self._http.stream("GET", path, headers=partial.headers()) as response:
            if response.is_error:
                await response.aread()
                check(response)
            partial.begin(response)
            try:
                async for chunk in response.aiter_raw():
                    count = partial.write(chunk)
                    if on_bytes is not None:
                        on_bytes(count)
            finally:
                partial.pause()

    async def _send(self, call: calls.Call[T], *, extra_s: float = 0.0) -> T:
        options = request_options(call, self._timeout_s + extra_s)
        for pause in pauses(self._retries if call.repeatable else 0):
            try:
                response = await self._http.request(**options)
            except httpx.TransportError as error:
                if pause is None:
                    raise unreachable(self.url, error) from error
                await anyio.sleep(pause)
                continue
            again = pause_after(response, call, pause)
            if again is None:
                check(response)
                return call.parse(response)
            await anyio.sleep(again)
        raise RuntimeError("the last try returns or raises")
