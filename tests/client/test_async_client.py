"""The asynchronous client does what the synchronous one does."""

import asyncio
import inspect
import threading
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from prtbake import AsyncClient, Client, InvalidRequest, JobNotSucceeded, NotFound, WaitTimeout
from prtbake_service.testing import LiveService
from prtbake_storage.contract.brdf import LambertSpec
from prtbake_storage.contract.jobs import JobError
from prtbake_storage.contract.resources import BrdfRegistration


def run(service: LiveService, work: Callable[[AsyncClient], Awaitable[Any]]) -> Any:
    async def inside() -> Any:
        async with AsyncClient(service.url, key=service.key) as client:
            return await work(client)

    return asyncio.run(inside())


def test_both_clients_have_the_same_methods() -> None:
    def methods(cls: type) -> dict[str, list[str]]:
        return {
            name: list(inspect.signature(value).parameters)
            for name, value in vars(cls).items()
            if inspect.isfunction(value) and not name.startswith("_")
        }

    assert methods(Client) == methods(AsyncClient)


def test_a_job_from_start_to_end(service: LiveService, fit: dict[str, Any]) -> None:
    async def work(client: AsyncClient) -> None:
        job = await client.submit(fit | {"label": "async"})
        with pytest.raises(WaitTimeout):
            await client.wait(job.id, timeout_s=0.1)
        threading.Timer(0.1, service.succeed, [job.id, {"n": 1}]).start()
        ended, events = await asyncio.gather(client.wait(job.id), _all(client.events(job.id)))
        assert ended.result == {"n": 1}
        assert [e.data["state"] for e in events] == ["queued", "running", "succeeded"]
        assert [j.id for j in await _all(client.jobs(label="async"))] == [job.id]
        await client.delete(job.id)
        with pytest.raises(NotFound):
            await client.job(job.id)

    run(service, work)


async def _all(items: Any) -> list[Any]:
    return [item async for item in items]


def test_failures(service: LiveService, fit: dict[str, Any]) -> None:
    async def work(client: AsyncClient) -> None:
        job = await client.submit(fit)
        service.fail(job.id, JobError(kind="internal", code="internal", detail="gone wrong"))
        with pytest.raises(JobNotSucceeded, match="gone wrong"):
            await client.wait(job.id)
        retried = await client.retry(job.id)
        assert (await client.cancel(retried.id)).state == "canceled"
        with pytest.raises(InvalidRequest):
            await client.submit({"kind": "nothing"})

    run(service, work)


def test_files_and_registration(service: LiveService, tmp_path: Path) -> None:
    path = tmp_path / "data.bin"
    path.write_bytes(b"async" * 500_000)
    canonical = service.backend.blobs.put_bytes(b"{}")

    async def work(client: AsyncClient) -> None:
        moved: list[int] = []
        upload = await client.upload(path, on_bytes=moved.append)
        assert sum(moved) == upload.size
        assert service.backend.blobs.size(upload.digest) == upload.size
        result = {"canonical": canonical, "understood": {}}
        service.answer_next("register", lambda job: service.succeed(job, result))
        brdf = await client.register(BrdfRegistration(spec=LambertSpec(albedo=0.25)))
        assert (await client.resource(brdf.id)).state == "ready"
        with pytest.raises(WaitTimeout):
            await client.register(BrdfRegistration(spec=LambertSpec(albedo=0.26)), timeout_s=0.3)

    run(service, work)
