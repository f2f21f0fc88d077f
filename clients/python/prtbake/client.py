"""The synchronous client."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self, TypeVar

import httpx

from prtbake import calls
from prtbake.config import discover
from prtbake.download import PartialFile
from prtbake.errors import JobNotSucceeded, ServiceFailed, ServiceUnreachable, WaitTimeout
from prtbake.files import chunks, file_digest
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
OnBytes = Callable[[int], None]
"""Told how many more bytes have moved."""


class Client:
    """Talk to a prtbake service.

    Parameters
    ----------
    url, key
        The service and an API key; by default those of ``PRTBAKE_URL`` and ``PRTBAKE_API_KEY``,
        or of the ``prtbake serve`` that runs on this machine; one that is starting is waited for,
        a minute at most.
    data_dir
        Data directory of a local service to find instead.
    timeout_s
        Longest silence of the service in a plain request.
    retries
        How often a request that may be repeated is sent again after a lost connection or a 503.
    transport
        Another httpx transport, for tests.

    Raises
    ------
    ServiceUnreachable
        When no service is named and none runs on this machine.

    Examples
    --------
    >>> with Client() as client:  # doctest: +SKIP
    ...     mesh = client.add_mesh(Path("bunny.obj"))
    ...     sky = client.register(EnvironmentRegistration(builtin={"name": "sun_sky"}))
    ...     job = client.submit(AssetRequest(mesh=mesh.id, brdf=GgxSpec(), environment=sky.id))
    ...     client.wait(job.id)
    ...     client.download_all(job.id, Path("out"))
    """

    def __init__(
        self,
        url: str | None = None,
        *,
        key: str | None = None,
        data_dir: Path | None = None,
        timeout_s: float = 30.0,
        retries: int = 2,
        transport: httpx.BaseTransport | None = None,
    ) -> None:
        endpoint = discover(url, key, data_dir)
        self.url = endpoint.url
        self._timeout_s = timeout_s
        self._retries = retries
        self._http = httpx.Client(
            transport=transport, **client_options(endpoint.url, endpoint.key, timeout_s)
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    # jobs

    def submit(
        self,
        request: calls.JobSpec,
        *,
        job_id: str | None = None,
        idempotency_key: str | None = None,
    ) -> Job:
        """Submit a job; the same key or id with the same request gives the same job."""
        return self._send(calls.submit_job(request, job_id=job_id, idempotency_key=idempotency_key))

    def estimate(self, request: calls.JobSpec) -> Estimate:
        """Say what a job would do and cost, without running it."""
        response = self._send(calls.estimate_job(request), extra_s=LONG_POLL_S)
        if response.status_code == 200:
            return calls.read_estimate(response)
        return estimate_of(self.wait(job_of_estimate(response)))

    def job(self, job_id: str) -> Job:
        """Read a job."""
        job, _ = self._send(calls.get_job(job_id))
        if job is None:
            raise RuntimeError("304 without having asked for it")
        return job

    def page(
        self,
        *,
        state: list[str] | None = None,
        kind: str | None = None,
        label: str | None = None,
        cursor: str | None = None,
        limit: int | None = None,
    ) -> JobPage:
        """Read one page of jobs, newest first."""
        return self._send(
            calls.list_jobs(state=state, kind=kind, label=label, cursor=cursor, limit=limit)
        )

    def jobs(
        self, *, state: list[str] | None = None, kind: str | None = None, label: str | None = None
    ) -> Iterator[Job]:
        """Walk all jobs, newest first, page by page."""
        cursor: str | None = None
        while True:
            page = self.page(state=state, kind=kind, label=label, cursor=cursor)
            yield from page.items
            cursor = page.next
            if cursor is None:
                return

    def follow(self, job_id: str, *, timeout_s: float | None = None) -> Iterator[Job]:
        """Yield the job now and whenever it changes, until it has ended.

        Once the job is known, a service that is away or at fault is asked again until ``timeout_s``
        is over, or for a minute.

        Raises
        ------
        WaitTimeout
            After ``timeout_s`` seconds; the job goes on.
        """
        start = time.monotonic()
        job, etag = self._send(calls.get_job(job_id))
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
                changed, etag = self._send(call, extra_s=left)
            except (ServiceUnreachable, ServiceFailed):
                if (pause := patience.pause()) is None:
                    raise
                time.sleep(pause)
                continue
            patience.answered()
            if changed is not None:
                job = changed
                yield job

    def wait(self, job_id: str, *, timeout_s: float | None = None, check: bool = True) -> Job:
        """Wait for a job to end.

        Raises
        ------
        JobNotSucceeded
            When it ended otherwise and ``check`` is set.
        WaitTimeout
            After ``timeout_s`` seconds; the job goes on.
        """
        (job,) = deque(self.follow(job_id, timeout_s=timeout_s), maxlen=1)
        if check and job.state is not JobState.succeeded:
            raise JobNotSucceeded(job)
        return job

    def events(
        self, job_id: str, *, after: int | None = None, follow: bool = True
    ) -> Iterator[Event]:
        """Yield the job's events from the first (or from ``after``) to its end.

        Without ``follow`` only those that there are now.
        A stream that breaks off is opened again at the last event seen, for a minute without one.
        """
        reader = EventReader(after)
        patience = Patience()
        while True:
            try:
                with self._http.stream(
                    "GET",
                    f"/v1/jobs/{job_id}/events",
                    headers=reader.headers(),
                    params={"follow": follow},
                    timeout=httpx.Timeout(self._timeout_s, read=STREAM_SILENCE_S),
                ) as response:
                    if response.is_error:
                        response.read()
                        check(response)
                    if response.status_code == 204:
                        return
                    for line in response.iter_lines():
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
                time.sleep(pause)

    def cancel(self, job_id: str) -> Job:
        """Ask for a job to stop; doing so twice, or after its end, changes nothing."""
        return self._send(calls.cancel_job(job_id))

    def retry(self, job_id: str) -> Job:
        """Start a new job that goes on from the last finished tile of one that did not succeed."""
        return self._send(calls.retry_job(job_id))

    def delete(self, job_id: str) -> None:
        """Remove a job that has ended, and its artefacts."""
        self._send(calls.delete_job(job_id))

    # files down

    def artefacts(self, job_id: str) -> list[Artefact]:
        """Read the manifest of a job's files."""
        return self._send(calls.list_artefacts(job_id))

    def download(
        self,
        job_id: str,
        artefact: Artefact | str,
        folder: Path,
        *,
        on_bytes: OnBytes | None = None,
    ) -> Path:
        """Download one file, going on where an earlier try stopped; return its path.

        Raises
        ------
        DownloadError
            When what came does not match the digest.
        """
        if isinstance(artefact, str):
            artefact = self._artefact(job_id, artefact)
        partial = PartialFile(artefact, folder)
        if partial.arrived:
            return partial.target
        for pause in pauses(self._retries):
            try:
                self._receive(job_id, partial, on_bytes)
            except httpx.TransportError as error:
                if pause is None:
                    raise unreachable(self.url, error) from error
                time.sleep(pause)
            if partial.complete:
                break
        return partial.finish()

    def download_all(
        self, job_id: str, folder: Path, *, on_bytes: OnBytes | None = None
    ) -> list[Path]:
        """Download every file of a job."""
        return [
            self.download(job_id, item, folder, on_bytes=on_bytes)
            for item in self.artefacts(job_id)
        ]

    # files up

    def upload(self, path: Path, *, on_bytes: OnBytes | None = None) -> Upload:
        """Upload a file unless the service holds its bytes already."""
        digest = file_digest(path)
        size = path.stat().st_size
        if not self._send(calls.missing_uploads([digest])).missing:
            return Upload(digest=digest, size=size)

        def counted() -> Iterator[bytes]:
            for chunk in chunks(path):
                yield chunk
                if on_bytes is not None:
                    on_bytes(len(chunk))

        try:
            response = self._http.put(
                f"/v1/uploads/{digest}", content=counted(), headers={"Content-Length": str(size)}
            )
        except httpx.TransportError as error:
            raise unreachable(self.url, error) from error
        check(response)
        return calls.read_upload(response)

    def register(
        self, registration: calls.Registration, *, timeout_s: float = REGISTER_S
    ) -> Resource:
        """Have a mesh, BRDF or environment parsed; return what was understood.

        Raises
        ------
        InvalidRequest
            When the file cannot be used; says what is wrong and where.
        WaitTimeout
            After ``timeout_s`` seconds; the parsing goes on.
        """
        start = time.monotonic()
        resource = self._send(calls.register(registration), extra_s=LONG_POLL_S)
        while resource.state == "parsing":
            left = min(LONG_POLL_S, start + timeout_s - time.monotonic())
            if left <= 0:
                raise WaitTimeout(resource, timeout_s)
            call = calls.get_resource(resource.id, wait_s=round(left, 3))
            resource = self._send(call, extra_s=left)
        return parsed(resource)

    def resource(self, resource_id: str) -> Resource:
        """Read a mesh, BRDF or environment."""
        return self._send(calls.get_resource(resource_id))

    def add_mesh(self, path: Path, **options: object) -> Resource:
        """Upload a mesh file and register it; options are those of ``MeshRegistration``."""
        body = {"blob": self.upload(path).digest, "filename": path.name, **options}
        return self.register(MeshRegistration.model_validate(body))

    def add_brdf(self, path: Path, **options: object) -> Resource:
        """Upload a BRDF file and register it; options are those of ``BrdfRegistration``."""
        body = {"blob": self.upload(path).digest, "filename": path.name, **options}
        return self.register(BrdfRegistration.model_validate(body))

    def add_environment(self, path: Path, **options: object) -> Resource:
        """Upload an HDR picture and register it; options: ``EnvironmentRegistration``."""
        body = {"blob": self.upload(path).digest, "filename": path.name, **options}
        return self.register(EnvironmentRegistration.model_validate(body))

    # the wire

    def _artefact(self, job_id: str, name: str) -> Artefact:
        for item in self.artefacts(job_id):
            if item.name == name:
                return item
        # let the service say it, in its own words and with its code
        check(self._http.get(calls.artefact_path(job_id, name)))
        raise LookupError(name)

    def _receive(self, job_id: str, partial: PartialFile, on_bytes: OnBytes | None) -> None:
        if partial.complete:
            return
        path = calls.artefact_path(job_id, partial.artefact.name)
        with self._http.stream("GET", path, headers=partial.headers()) as response:
            if response.is_error:
                response.read()
                check(response)
            partial.begin(response)
            try:
                # as they come: a chunker would lose what it holds when the connection breaks
                for chunk in response.iter_raw():
                    count = partial.write(chunk)
                    if on_bytes is not None:
                        on_bytes(count)
            finally:
                partial.pause()

    def _send(self, call: calls.Call[T], *, extra_s: float = 0.0) -> T:
        options = request_options(call, self._timeout_s + extra_s)
        for pause in pauses(self._retries if call.repeatable else 0):
            try:
                response = self._http.request(**options)
            except httpx.TransportError as error:
                if pause is None:
                    raise unreachable(self.url, error) from error
                time.sleep(pause)
                continue
            again = pause_after(response, call, pause)
            if again is None:
                check(response)
                return call.parse(response)
            time.sleep(again)
        raise RuntimeError("the last try returns or raises")
