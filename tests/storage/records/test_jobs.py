"""Jobs in the database: submission, transitions, pages."""

import itertools
import threading
from datetime import UTC, datetime, timedelta, timezone

import pytest
import sqlalchemy as sa

from prtbake_storage.contract.jobs import TERMINAL, JobError, JobState, Progress
from prtbake_storage.errors import Conflict, InputError, NotFound
from prtbake_storage.records import Database, Events, Jobs, NewArtefact, NewJob, Runs, Stop
from prtbake_storage.records.models import EventRow, JobRow
from prtbake_storage.records.runs import TaskProgress
from prtbake_storage.records.transitions import AFTER, before
from support.rows import context_of, revision_of

ERROR = JobError(kind="internal", code="internal", detail="it broke", pointer="/x")
ARTEFACT = NewArtefact("asset.h5", "application/x-hdf5", "sha256:" + "0" * 64, 3)


def new_job(job_id: str, **changes: object) -> NewJob:
    return NewJob(**({"id": job_id, "kind": "bake", "request": {"n": 1}} | changes))  # type: ignore[arg-type]


def put_in_state(database: Database, job_id: str, state: JobState) -> None:
    """Bring a new job to a state by its legal way."""
    jobs, runs = Jobs(database), Runs(database)
    jobs.create(new_job(job_id))
    if state != JobState.queued:
        runs.start(job_id)
    if state in (JobState.cancel_requested, JobState.canceled):
        jobs.request_cancel(job_id)
    if state == JobState.succeeded:
        assert runs.succeed(job_id, result={}, artefacts=[ARTEFACT], progress=Progress())
    elif state in (JobState.canceled, JobState.failed, JobState.expired):
        assert runs.close(job_id, Stop(state))
    assert jobs.get(job_id).state == state


def test_a_submitted_job_comes_back_whole(database: Database) -> None:
    jobs = Jobs(database)
    job, is_new = jobs.create(
        new_job("a", label="étude", priority=7, timeout_s=9.5, retry_of="z", context={"mesh": "m"})
    )
    assert is_new
    assert jobs.get("a") == job
    assert (job.state, job.label, job.retry_of, job.request) == ("queued", "étude", "z", {"n": 1})
    assert job.created.tzinfo is not None
    assert abs(job.created - datetime.now(UTC)) < timedelta(minutes=1)
    assert context_of(database, "a") == {"mesh": "m"}


def test_nobody_sees_another_projects_job(database: Database) -> None:
    jobs = Jobs(database)
    jobs.create(new_job("a", project="mine"))
    assert jobs.get("a", project="mine").id == "a"
    for ask in (jobs.get, jobs.request_cancel, jobs.delete):
        with pytest.raises(NotFound):
            ask("a", project="theirs")
        with pytest.raises(NotFound):
            ask("nothing")
    assert jobs.page(project="theirs").items == []
    with pytest.raises(Conflict):
        jobs.create(new_job("a", project="theirs"))


def test_the_same_key_and_body_give_the_same_job(database: Database) -> None:
    jobs = Jobs(database)
    first, _ = jobs.create(new_job("a", idempotency_key="k", body_digest="sha256:1"))
    again, is_new = jobs.create(new_job("b", idempotency_key="k", body_digest="sha256:1"))
    assert (again.id, is_new) == (first.id, False)
    with pytest.raises(Conflict, match="another request"):
        jobs.create(new_job("c", idempotency_key="k", body_digest="sha256:2"))
    with pytest.raises(Conflict, match="another request"):
        jobs.create(new_job("a", body_digest="sha256:2"))
    other, is_new = jobs.create(
        new_job("d", idempotency_key="k", body_digest="sha256:2", project="other")
    )
    assert (other.id, is_new) == ("d", True)


def test_many_submissions_with_one_key_make_one_job(database: Database) -> None:
    n_threads = 6
    start = threading.Barrier(n_threads)
    made: list[tuple[str, bool]] = []

    def submit(index: int) -> None:
        start.wait()
        job, is_new = Jobs(database).create(
            new_job(f"job-{index}", idempotency_key="k", body_digest="sha256:1")
        )
        made.append((job.id, is_new))

    threads = [threading.Thread(target=submit, args=(index,)) for index in range(n_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len({job_id for job_id, _ in made}) == 1
    assert [is_new for _, is_new in made].count(True) == 1


def test_terminal_states_are_closed() -> None:
    assert all(not AFTER[state] for state in TERMINAL)
    assert set(AFTER) == set(JobState)
    assert before(JobState.queued) == frozenset()
    # a cancellation that was asked for ends in nothing but cancellation
    assert AFTER[JobState.cancel_requested] == {JobState.canceled}


@pytest.mark.parametrize("state", list(JobState))
def test_only_legal_transitions_happen(database: Database, state: JobState) -> None:
    jobs, runs = Jobs(database), Runs(database)
    moves = {
        JobState.running: lambda name: runs.start(name),
        JobState.cancel_requested: lambda name: jobs.request_cancel(name),
        JobState.succeeded: lambda name: runs.succeed(
            name, result={}, artefacts=[ARTEFACT], progress=Progress()
        ),
        JobState.failed: lambda name: runs.close(name, Stop(JobState.failed, ERROR)),
        JobState.canceled: lambda name: runs.close(name, Stop(JobState.canceled)),
        JobState.expired: lambda name: runs.close(name, Stop(JobState.expired)),
    }
    for target, move in moves.items():
        name = f"{state}-{target}"
        put_in_state(database, name, state)
        history = len(Events(database).after(name))
        move(name)
        reached = jobs.get(name).state
        assert reached == state or reached in AFTER[state]
        changed = len(Events(database).after(name)) - history
        assert changed == (0 if reached == state else 1)
        if state in TERMINAL:
            assert reached == state


def test_a_cancelled_job_shows_no_artefact(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    put_in_state(database, "a", JobState.cancel_requested)
    assert not runs.succeed("a", result={"x": 1}, artefacts=[ARTEFACT], progress=Progress())
    assert runs.close("a", Stop(JobState.failed, ERROR))  # what came up while stopping
    job = jobs.get("a")
    assert (job.state, job.artefacts, job.result, job.error) == ("canceled", [], None, None)


def test_success_publishes_artefacts_once(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    put_in_state(database, "a", JobState.running)
    files = [ARTEFACT, ARTEFACT._replace(name="report.json", size=2**40)]
    arguments = {"result": {"x": 1}, "artefacts": files, "progress": Progress(fraction=0.7)}
    assert runs.succeed("a", **arguments)
    assert not runs.succeed("a", **arguments)
    job = jobs.get("a")
    assert [artefact.name for artefact in job.artefacts] == ["asset.h5", "report.json"]
    assert job.artefacts[1].size == 2**40
    assert (job.result, job.progress.fraction) == ({"x": 1}, 1.0)
    assert job.started is not None
    assert job.finished is not None
    assert job.created <= job.started <= job.finished


def test_a_failing_job_tells_its_tasks_first_and_its_caller_last(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    put_in_state(database, "a", JobState.running)
    assert runs.stop("a") is None
    runs.fail_soon("a", ERROR)
    runs.fail_soon("a", ERROR.model_copy(update={"code": "later"}))  # the first cause counts
    assert runs.stop("a") == Stop(JobState.failed, ERROR)
    assert (jobs.get("a").state, jobs.get("a").error) == ("running", None)
    assert not runs.succeed("a", result={}, artefacts=[], progress=Progress())
    assert runs.close("a", Stop(JobState.failed, ERROR))
    assert (jobs.get("a").state, jobs.get("a").error) == ("failed", ERROR)
    assert Events(database).after("a")[-1].data == {"state": "failed", "error": ERROR.model_dump()}


def test_a_deadline_counts_from_the_start(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    jobs.create(new_job("late", timeout_s=0.001))
    jobs.create(new_job("in-time", timeout_s=1000.0))
    assert runs.stop("late") is None
    runs.start("late")
    runs.start("in-time")
    threading.Event().wait(0.05)
    stop = runs.stop("late")
    assert stop is not None
    assert stop.state is JobState.expired
    assert stop.error is not None
    assert "time limit of 0.001 s" in stop.error.detail
    assert runs.stop("in-time") is None


def test_a_job_taken_up_again_keeps_its_start_and_its_progress(database: Database) -> None:
    runs = Runs(database)
    put_in_state(database, "a", JobState.queued)
    first = runs.start("a")
    runs.progress("a", Progress(stage="tiles", fraction=0.5))
    again = runs.start("a")
    assert first is not None
    assert again is not None
    assert again.started == first.started
    assert again.fraction == 0.5
    assert [event.data.get("state") for event in Events(database).after("a")].count("running") == 1


def test_the_fraction_never_falls(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    put_in_state(database, "a", JobState.running)
    seen = []
    for fraction in (0.1, 0.5, 0.3, 0.6):
        runs.progress("a", Progress(fraction=fraction))
        seen.append(jobs.get("a").progress.fraction)
    assert seen == [0.1, 0.5, 0.5, 0.6]
    runs.close("a", Stop(JobState.failed, ERROR))
    runs.progress("a", Progress(fraction=0.9))
    assert jobs.get("a").progress.fraction == 0.6


def test_every_change_is_a_new_revision(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    revisions = []
    put_in_state(database, "a", JobState.queued)
    revisions.append(revision_of(database, "a"))
    for change in (
        lambda: runs.start("a"),
        lambda: runs.progress("a", Progress(fraction=0.1)),
        lambda: jobs.request_cancel("a"),
        lambda: runs.close("a", Stop(JobState.canceled)),
    ):
        change()
        revisions.append(revision_of(database, "a"))
    assert revisions == sorted(set(revisions))
    jobs.request_cancel("a")
    assert revision_of(database, "a") == revisions[-1]


def test_task_progress_is_kept_until_the_end(database: Database) -> None:
    runs = Runs(database)
    put_in_state(database, "a", JobState.running)
    for done in (1.0, 2.0):
        runs.task_progress("a", 0, TaskProgress(3, done, 4.0, "rows"))
    runs.task_progress("a", 1, TaskProgress(0, 1.0, 1.0, "files"))
    runs.task_progress("no-such-job", 0, TaskProgress(0, 1.0, 1.0, ""))
    assert runs.tasks_under_way("a", 0) == [TaskProgress(3, 2.0, 4.0, "rows")]
    runs.close("a", Stop(JobState.failed, ERROR))
    assert runs.tasks_under_way("a", 0) == []


def test_pages_are_stable_while_jobs_come_in(database: Database) -> None:
    jobs = Jobs(database)
    for index in range(7):
        jobs.create(new_job(f"job-{index}"))
    with database.write() as session:  # the same moment for three: the id decides
        moment = session.get_one(JobRow, "job-3").created
        session.execute(
            sa.update(JobRow).where(JobRow.id.in_(["job-2", "job-4"])).values(created=moment)
        )
    seen, cursor = [], None
    for round_number in itertools.count():
        page = jobs.page(limit=2, cursor=cursor)
        seen += [job.id for job in page.items]
        jobs.create(new_job(f"newcomer-{round_number}"))
        if (cursor := page.next) is None:
            break
    assert seen == [f"job-{index}" for index in (6, 5, 4, 3, 2, 1, 0)]


@pytest.mark.parametrize("cursor", ["x", "AAAA", "é", "MjAyNi0wMS0wMXxh", "=" * 9])
def test_a_made_up_cursor_is_refused(database: Database, cursor: str) -> None:
    with pytest.raises(InputError, match="cursor"):
        Jobs(database).page(cursor=cursor)


def test_filters_combine(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    jobs.create(new_job("a", kind="bake", label="x"))
    jobs.create(new_job("b", kind="asset", label="x"))
    jobs.create(new_job("c", kind="asset", label="y"))
    jobs.create(new_job("hidden", kind="register", internal=True))
    runs.start("c")
    moment = jobs.get("b").created
    east = timezone(timedelta(hours=5))

    def ids(**filters: object) -> list[str]:
        return [job.id for job in jobs.page(**filters).items]  # type: ignore[arg-type]

    assert ids() == ["c", "b", "a"]
    assert ids(states=[JobState.queued]) == ["b", "a"]
    assert ids(kinds=["asset"]) == ["c", "b"]
    assert ids(label="x", kinds=["asset"]) == ["b"]
    assert ids(created_after=moment.astimezone(east)) == ["c"]
    assert ids(created_before=moment) == ["a"]
    assert ids(internal=True) == ["hidden"]
    assert jobs.counts()["queued"] == 3


def test_only_a_terminal_job_is_deleted_and_its_history_with_it(database: Database) -> None:
    jobs, runs = Jobs(database), Runs(database)
    put_in_state(database, "a", JobState.running)
    with pytest.raises(Conflict, match="running"):
        jobs.delete("a")
    assert runs.succeed("a", result={}, artefacts=[ARTEFACT], progress=Progress())
    jobs.delete("a")
    assert Events(database).after("a") == []
    jobs.create(new_job("a"))
    assert jobs.get("a").artefacts == []


def test_events_replay_after_the_last_seen(database: Database) -> None:
    events = Events(database)
    put_in_state(database, "a", JobState.running)
    put_in_state(database, "b", JobState.running)
    events.log("a", "hello", worker="w")
    everything = events.after("a")
    assert [event.type for event in everything] == ["state", "state", "log"]
    assert everything[-1].data == {"message": "hello", "worker": "w"}
    ids = [event.id for event in everything]
    assert ids == sorted(set(ids))
    assert events.after("a", ids[1]) == everything[2:]
    assert events.after("a", limit=1) == everything[:1]


def test_events_of_one_job_appear_in_the_order_of_their_ids(database: Database) -> None:
    """A reader that follows the last id it saw must miss none, however the writers race."""
    events, n_writers, n_each = Events(database), 4, 10
    put_in_state(database, "a", JobState.queued)
    seen: list[int] = []
    done = threading.Event()

    def follow() -> None:
        last = 0
        while True:
            finished = done.is_set()
            for event in events.after("a", last):
                seen.append(last := event.id)
            if finished:
                return

    def write() -> None:
        for _ in range(n_each):
            events.log("a", "line")

    reader = threading.Thread(target=follow)
    writers = [threading.Thread(target=write) for _ in range(n_writers)]
    for thread in (reader, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    reader.join()
    assert seen == [event.id for event in events.after("a")]
    assert len(seen) == n_writers * n_each + 1


def test_progress_is_thinned_once_its_job_has_ended(database: Database) -> None:
    jobs, runs, events = Jobs(database), Runs(database), Events(database)
    for name in ("ends", "runs"):
        jobs.create(new_job(name))
        runs.start(name)
        with database.write() as session:
            for second in range(1000):
                progress = Progress(stage_index=second // 500, fraction=second / 2000, done=second)
                data, now = progress.model_dump(mode="json"), datetime.now(UTC)
                session.add(EventRow(job_id=name, type="progress", data=data, created=now))
        events.log(name, "half way")
    assert runs.close("ends", Stop(JobState.failed, ERROR))
    told = [event for event in events.after("ends", limit=5000) if event.type == "progress"]
    # 0 to 50 percent, one of them twice: the stages change within it
    assert 50 <= len(told) <= 52
    assert {499, 999} <= {event.data["done"] for event in told}
    assert [event.id for event in told] == sorted(event.id for event in told)
    others = [event.type for event in events.after("ends", limit=5000) if event.type != "progress"]
    assert others == ["state", "state", "log", "state"]
    assert len(events.after("runs", limit=5000)) == 1000 + 3  # whoever follows it misses nothing
