import threading
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

import prtbake
from prtbake import (
    Client,
    Conflict,
    InvalidRequest,
    JobNotSucceeded,
    NotFound,
    Unauthorised,
    retrying,
)
from prtbake_service.testing import LiveService
from prtbake_storage.contract.brdf import GgxSpec
from prtbake_storage.contract.jobs import AssetRequest, FitLightRequest, JobError, Progress
from prtbake_storage.contract.resources import BrdfRegistration, Resource


def test_what_is_exported_is_listed() -> None:
    for name in prtbake.__all__:
        assert getattr(prtbake, name) is not None
    public = {
        name
        for name, value in vars(prtbake).items()
        if getattr(value, "__module__", "").startswith("prtbake.")
    }
    assert public <= set(prtbake.__all__)
    with pytest.raises(AttributeError):
        _ = prtbake.nothing


def test_submit_takes_models_and_json(client: Client, environment: str) -> None:
    model = FitLightRequest(environment=environment, label="model")
    job = client.submit(model)
    assert client.job(job.id) == job
    same = client.submit(model.model_dump(mode="json"), job_id="by-hand")
    assert client.submit(model, job_id="by-hand").id == same.id == "by-hand"
    with pytest.raises(Conflict):
        client.submit(model.model_copy(update={"seed": 1}), job_id="by-hand")


def test_a_model_keeps_its_tags(client: Client) -> None:
    request = AssetRequest(
        mesh="mesh-00000000000000aa", brdf=GgxSpec(), environment="environment-00000000000000aa"
    )
    with pytest.raises(NotFound) as caught:  # not 422: kind and model went over the wire
        client.submit(request)
    assert caught.value.problem.pointer == "/mesh"


def test_errors_say_what_and_where(client: Client, service: LiveService) -> None:
    with pytest.raises(InvalidRequest, match=r"/environment.*422") as caught:
        client.submit({"kind": "fit_light", "environment": 3})
    assert caught.value.request_id
    assert isinstance(caught.value, ValueError)
    with pytest.raises(NotFound, match="no job nothing"):
        client.job("nothing")
    with Client(service.url, key="wrong") as stranger, pytest.raises(Unauthorised):
        stranger.page()


def test_unreachable() -> None:
    with (
        Client("http://127.0.0.1:9", retries=0) as client,
        pytest.raises(prtbake.ServiceUnreachable, match=r"127\.0\.0\.1:9"),
    ):
        client.page()


def test_wait_and_follow(client: Client, service: LiveService, fit: dict[str, Any]) -> None:
    job = client.submit(fit)
    with pytest.raises(prtbake.WaitTimeout):
        client.wait(job.id, timeout_s=0.1)

    def work() -> None:
        service.begin(job.id)
        service.runs.progress(job.id, Progress(stage="fit", fraction=0.5))
        service.succeed(job.id, {"errors": {"fit": 0.01}})

    threading.Timer(0.2, work).start()
    seen = [found.state for found in client.follow(job.id, timeout_s=20)]
    assert seen[0] == "queued"
    assert seen[-1] == "succeeded"
    assert client.wait(job.id).result == {"errors": {"fit": 0.01}}


def test_wait_raises_what_the_job_died_of(
    client: Client, service: LiveService, fit: dict[str, Any]
) -> None:
    job = client.submit(fit)
    service.fail(job.id, JobError(kind="input", code="x", detail="too few lobes", pointer="/s"))
    with pytest.raises(JobNotSucceeded, match="too few lobes") as caught:
        client.wait(job.id)
    assert caught.value.job.state == "failed"
    assert client.wait(job.id, check=False).state == "failed"


def test_events_follow_to_the_end(
    client: Client, service: LiveService, fit: dict[str, Any]
) -> None:
    job = client.submit(fit)
    assert [e.data["state"] for e in client.events(job.id, follow=False)] == ["queued"]
    threading.Timer(0.15, service.succeed, [job.id, {}]).start()
    events = list(client.events(job.id))
    assert [e.data["state"] for e in events] == ["queued", "running", "succeeded"]
    assert list(client.events(job.id, after=events[-1].id)) == []


def test_cancel_retry_delete(client: Client, fit: dict[str, Any]) -> None:
    job = client.submit(fit)
    assert client.cancel(job.id).state == "canceled"
    retried = client.retry(job.id)
    assert retried.retry_of == job.id
    client.delete(job.id)
    with pytest.raises(NotFound):
        client.job(job.id)


def test_jobs_walks_all_pages(client: Client, fit: dict[str, Any]) -> None:
    made = {client.submit(fit | {"label": "walk"}).id for _ in range(23)}
    assert {job.id for job in client.jobs(label="walk")} == made
    assert list(client.jobs(label="walk", state=["failed"])) == []


def test_upload_only_what_is_missing(client: Client, service: LiveService, tmp_path: Path) -> None:
    path = tmp_path / "mesh.obj"
    path.write_bytes(b"v 0 0 0\n" * 300_000)
    moved: list[int] = []
    upload = client.upload(path, on_bytes=moved.append)
    assert sum(moved) == upload.size == path.stat().st_size
    assert service.backend.blobs.read_bytes(upload.digest) == path.read_bytes()
    moved.clear()
    assert client.upload(path, on_bytes=moved.append) == upload
    assert moved == []


def test_too_large_an_upload(client: Client, service: LiveService, tmp_path: Path) -> None:
    path = tmp_path / "big"
    path.write_bytes(b"0" * (service.backend.settings.max_upload_bytes + 1))
    with pytest.raises(InvalidRequest, match="413"):
        client.upload(path)


def test_registration_waits_and_refuses(
    client: Client, service: LiveService, tmp_path: Path
) -> None:
    canonical = service.backend.blobs.put_bytes(b"{}")
    result = {"canonical": canonical, "understood": {"spec": {}}}
    # later than the service waits, so the client goes on asking
    service.answer_next(
        "register", lambda job: threading.Timer(0.4, service.succeed, [job, result]).start()
    )
    brdf = client.register(BrdfRegistration(spec=GgxSpec(alpha=0.123)))
    assert brdf.state == "ready"
    assert client.resource(brdf.id) == brdf

    error = JobError(kind="input", code="invalid-mesh", detail="line 2: NaN", pointer="/blob")
    service.answer_next(
        "register", lambda job: threading.Timer(0.4, service.fail, [job, error]).start()
    )
    path = tmp_path / "bad.obj"
    path.write_text("v nan 0 0")
    with pytest.raises(InvalidRequest, match="line 2: NaN") as caught:
        client.add_mesh(path)
    assert caught.value.problem.code == "invalid-mesh"


def test_registration_waits_no_longer_than_told(client: Client, service: LiveService) -> None:
    registration = BrdfRegistration(spec=GgxSpec(alpha=0.321))
    with pytest.raises(prtbake.WaitTimeout, match=r"still parsing after 0\.3 s") as caught:
        client.register(registration, timeout_s=0.3)
    assert isinstance(caught.value.waited_for, Resource)
    # whoever cancels its job ends the waiting of others
    job = f"parse-{caught.value.waited_for.id}"
    cancelling = threading.Timer(0.4, client.cancel, [job])
    cancelling.start()
    with pytest.raises(prtbake.ApiError, match="canceled"):
        client.register(registration, timeout_s=20)
    # its own answer may come later, and needs the client
    cancelling.join()


def test_estimate_waits_past_a_202(
    client: Client, service: LiveService, fit: dict[str, Any]
) -> None:
    estimate = {
        "plan": {"n_lobes": 162},
        "seconds": {"fit": 1.5},
        "total_seconds": 1.5,
        "artefact_bytes": {},
        "peak_memory_bytes": 0,
        "errors": {},
    }
    service.answer_next(
        "estimate", lambda job: threading.Timer(0.4, service.succeed, [job, estimate]).start()
    )
    assert client.estimate(fit).total_seconds == 1.5


def test_a_busy_service_is_asked_again() -> None:
    calls: list[httpx.Request] = []

    def answer(request: httpx.Request) -> httpx.Response:
        calls.append(request)
        if len(calls) == 1:
            return httpx.Response(503, headers={"Retry-After": "0"})
        return httpx.Response(200, json={"items": [], "next": None})

    with Client("http://service", transport=httpx.MockTransport(answer)) as client:
        assert client.page().items == []
    assert len(calls) == 2


def test_a_lost_answer_is_asked_for_with_the_same_key() -> None:
    keys: list[str] = []

    def answer(request: httpx.Request) -> httpx.Response:
        keys.append(request.headers["idempotency-key"])
        if len(keys) == 1:
            raise httpx.ReadError("cut", request=request)
        return httpx.Response(500, json={})

    with (
        Client("http://service", transport=httpx.MockTransport(answer)) as client,
        pytest.raises(prtbake.ServiceFailed),
    ):
        client.submit({"kind": "fit_light"})
    assert len(keys) == 2
    assert keys[0] == keys[1]


class Gate(httpx.HTTPTransport):
    """The way to the service; while ``down`` it is refused, or a proxy answers in its place."""

    def __init__(self) -> None:
        super().__init__()
        self.down: str | None = None

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if self.down == "refused":
            raise httpx.ConnectError("refused", request=request)
        if self.down == "faulty":
            return httpx.Response(502, request=request, text="bad gateway")
        return super().handle_request(request)


@pytest.mark.parametrize("how", ["refused", "faulty"])
@pytest.mark.parametrize("call", ["wait", "wait without limit", "events"])
def test_waiting_survives_a_restart_of_the_service(
    service: LiveService, fit: dict[str, Any], how: str, call: str
) -> None:
    gate = Gate()
    with Client(service.url, key=service.key, transport=gate) as client:
        job = client.submit(fit)

        def restart() -> None:
            gate.down = how
            service.begin(job.id)  # which ends the long poll under way
            time.sleep(2.0)  # longer than a plain request is repeated
            service.succeed(job.id, {})
            gate.down = None

        if call == "events":
            reader = client.events(job.id)
            assert next(reader).data["state"] == "queued"
            reader.close()
            gate.down = how
            restarting = threading.Thread(target=restart)
            restarting.start()
            seen = [event.data["state"] for event in client.events(job.id)]
            assert seen == ["queued", "running", "succeeded"]
        else:
            limit = 30.0 if call == "wait" else None
            followed = client.follow(job.id, timeout_s=limit)
            assert next(followed).state == "queued"
            restarting = threading.Thread(target=restart)
            restarting.start()
            assert list(followed)[-1].state == "succeeded"
        restarting.join()


def test_patience_has_an_end(
    service: LiveService, fit: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrying, "AWAY_S", 0.3)
    gate = Gate()
    with Client(service.url, key=service.key, transport=gate, retries=0) as client:
        job = client.submit(fit)
        for how, error in (
            ("refused", prtbake.ServiceUnreachable),
            ("faulty", prtbake.ServiceFailed),
        ):
            for limit in (None, 0.3):
                gate.down = None
                followed = client.follow(job.id, timeout_s=limit)
                next(followed)
                gate.down = how
                with pytest.raises((error, prtbake.WaitTimeout)):
                    next(followed)
            with pytest.raises(error):
                next(client.events(job.id))
        # and a service that was never seen is not waited for
        start = time.monotonic()
        with pytest.raises(prtbake.ServiceFailed):
            client.wait(job.id, timeout_s=30.0)
        assert time.monotonic() - start < 5.0
