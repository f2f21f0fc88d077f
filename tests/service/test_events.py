"""Server-sent events: ids, replay, heartbeat, end."""

import json
import threading

import httpx

from prtbake_service.testing import LiveService
from prtbake_storage.contract.jobs import Event, Progress


def read(http: httpx.Client, job_id: str, **headers: str) -> list[Event]:
    """Read a stream to its end."""
    answer = http.get(f"/v1/jobs/{job_id}/events", headers=headers)
    assert answer.headers["content-type"].startswith("text/event-stream")
    blocks = [block for block in answer.text.split("\n\n") if "data:" in block]
    events = []
    for block in blocks:
        fields = dict(line.split(": ", 1) for line in block.splitlines())
        event = Event.model_validate(json.loads(fields["data"]))
        assert str(event.id) == fields["id"]
        assert event.type == fields["event"]
        events.append(event)
    return events


def test_history_and_replay(service: LiveService, http, submit) -> None:
    job = submit()
    service.begin(job["id"])
    service.runs.progress(job["id"], Progress(stage="fit", fraction=0.5))
    service.backend.events.log(job["id"], "half\nway")
    service.succeed(job["id"], {})
    events = read(http, job["id"])
    told = [
        (e.type, e.data.get("state") or e.data.get("stage") or e.data["message"]) for e in events
    ]
    assert told == [
        ("state", "queued"),
        ("state", "running"),
        ("progress", "fit"),
        ("log", "half\nway"),
        ("state", "succeeded"),
    ]
    assert [e.id for e in events] == sorted({e.id for e in events})
    rest = read(http, job["id"], **{"Last-Event-ID": str(events[1].id)})
    assert [e.id for e in rest] == [e.id for e in events[2:]]
    over = http.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": str(events[-1].id)})
    assert over.status_code == 204


def test_events_come_as_they_happen(service: LiveService, http, submit) -> None:
    job = submit()
    threading.Timer(0.3, service.succeed, [job["id"], {}]).start()
    with http.stream("GET", f"/v1/jobs/{job['id']}/events") as answer:
        assert answer.headers["cache-control"].startswith("no-store")
        lines = list(answer.iter_lines())
    assert lines[0].startswith("retry: ")
    assert ": heartbeat" in lines
    states = [json.loads(line[6:])["data"]["state"] for line in lines if line.startswith("data: ")]
    assert states == ["queued", "running", "succeeded"]


def test_without_follow_the_stream_ends(http, submit) -> None:
    job = submit()
    answer = http.get(f"/v1/jobs/{job['id']}/events?follow=false")
    assert answer.text.count("data: ") == 1


def test_a_last_event_id_that_is_no_number(http, submit) -> None:
    job = submit()
    answer = http.get(f"/v1/jobs/{job['id']}/events", headers={"Last-Event-ID": "x"})
    assert answer.status_code == 422


def test_no_events_of_no_job(http: httpx.Client) -> None:
    assert http.get("/v1/jobs/none/events").status_code == 404
