"""Database, migrations, clock, and the smaller tables."""

import subprocess
import sys
import threading
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from prtbake_storage.contract.jobs import JobError, JobState, Progress
from prtbake_storage.errors import NotFound, SettingsError
from prtbake_storage.records import (
    Begun,
    Database,
    Jobs,
    Key,
    Keys,
    NewArtefact,
    NewJob,
    Registrations,
    Resources,
    Runs,
    Stop,
    Uploads,
    Workers,
    create_database,
    referenced_blobs,
    registrations,
)
from prtbake_storage.records.clock import UtcDateTime
from prtbake_storage.records.database import normalise_url
from prtbake_storage.records.models import Base, JobRow
from prtbake_storage.testing.blob_contract import digest_of


def test_the_migrations_make_the_tables_of_the_models(database: Database) -> None:
    with database.engine.connect() as connection:
        context = MigrationContext.configure(
            connection, opts={"version_table": "prtbake_migrations"}
        )
        assert compare_metadata(context, Base.metadata) == []
        # the negative twin: a table that the migrations do not make is found
        changed = sa.MetaData()
        for table in Base.metadata.tables.values():
            table.to_metadata(changed)
        sa.Table("forgotten", changed, sa.Column("id", sa.Integer, primary_key=True))
        assert compare_metadata(context, changed) != []


def test_several_processes_migrate_at_once(database_url: str) -> None:
    code = (
        "import sys; from prtbake_storage.records import create_database;"
        "create_database(sys.argv[1]).dispose()"
    )
    processes = [subprocess.Popen([sys.executable, "-c", code, database_url]) for _ in range(2)]
    assert [process.wait(timeout=60.0) for process in processes] == [0, 0]
    create_database(database_url).dispose()


def test_sqlite_waits_for_other_writers(tmp_path: Path) -> None:
    database = create_database(f"sqlite:///{tmp_path / 'x.sqlite'}")
    with database.read() as session:
        assert session.scalar(sa.text("PRAGMA journal_mode")) == "wal"
        assert int(session.scalar(sa.text("PRAGMA busy_timeout")) or 0) >= 10_000
        assert session.scalar(sa.text("PRAGMA foreign_keys")) == 1
    database.dispose()


@pytest.mark.parametrize("url", ["sqlite://", "sqlite:///:memory:", "mysql://x/y", "nonsense"])
def test_a_database_that_cannot_be_shared_is_refused(url: str) -> None:
    with pytest.raises(SettingsError) as caught:
        normalise_url(url)
    assert caught.value.pointer == "/database_url"


def test_moments_keep_their_zone(database: Database) -> None:
    Jobs(database).create(NewJob(id="a", kind="bake", request={}))
    moment = datetime(2026, 3, 4, 5, 6, 7, 891011, timezone(timedelta(hours=-3)))
    with database.write() as session:
        session.get_one(JobRow, "a").created = moment
    created = Jobs(database).get("a").created
    assert created == moment
    assert created.utcoffset() == timedelta(0)
    naive = sa.select(sa.literal(moment.replace(tzinfo=None), UtcDateTime))
    with pytest.raises(sa.exc.StatementError, match="time zone"), database.read() as session:
        session.execute(naive)


def test_a_failed_transaction_leaves_nothing(database: Database) -> None:
    Jobs(database).create(NewJob(id="a", kind="bake", request={}))

    def change_and_fail() -> None:
        with database.write() as session:
            session.get_one(JobRow, "a").label = "half done"
            session.flush()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        change_and_fail()
    assert Jobs(database).get("a").label is None


def test_the_database_refuses_an_unknown_state(database: Database) -> None:
    Jobs(database).create(NewJob(id="a", kind="bake", request={}))
    with pytest.raises(sa.exc.IntegrityError), database.write() as session:
        session.get_one(JobRow, "a").state = "lost"


def test_uploads_belong_to_projects(database: Database) -> None:
    uploads = Uploads(database)
    one, two = digest_of(b"1"), digest_of(b"2")
    assert uploads.add(one, 10, project="mine")
    assert not uploads.add(one, 10, project="mine")
    assert uploads.add(one, 10, project="theirs")
    assert uploads.get(one, project="mine").size == 10
    assert uploads.missing([two, one], project="mine") == [two]
    assert uploads.missing([two, one], project="nobody") == [two, one]
    with pytest.raises(NotFound):
        uploads.get(two, project="mine")


RESOURCE = "mesh-0123456789abcdef"


def parser(resource_id: str = RESOURCE) -> NewJob:
    context = {"resource_id": resource_id}
    return NewJob(id="r", kind="register", request={}, context=context, internal=True, quick=True)


def begin(database: Database, **options: bool) -> Begun:
    request = {"blob": digest_of(b"m")}
    return Registrations(database).begin(
        RESOURCE, "mesh", request, parser(), label="bunny", **options
    )


def register(database: Database) -> None:
    begin(database)
    Runs(database).start("r")


def test_a_registration_that_succeeds_makes_its_resource_ready(database: Database) -> None:
    register(database)
    resources, canonical = Resources(database), digest_of(b"canonical")
    assert resources.get(RESOURCE).state == "parsing"
    result = {"canonical": canonical, "understood": {"n_vertices": 3}}
    assert Runs(database).succeed("r", result=result, artefacts=[], progress=Progress())
    resource = resources.get(RESOURCE)
    assert (resource.state, resource.canonical) == ("ready", canonical)
    assert resource.understood == {"n_vertices": 3}


def test_a_registration_that_fails_says_why_in_its_resource(database: Database) -> None:
    register(database)
    error = JobError(kind="input", code="invalid-mesh", detail="vertex 7 is NaN", pointer="/blob")
    assert Runs(database).close("r", Stop(JobState.failed, error))
    resource = Resources(database).get(RESOURCE)
    assert (resource.state, resource.problem) == ("refused", error.model_dump())
    # once more: the parser may have learned since
    begun = begin(database)
    assert begun.job is not None
    assert begun.job.id.startswith("r-")
    assert (begun.resource.state, begun.resource.problem) == ("parsing", None)
    assert Jobs(database).get(begun.job.id).state == "queued"


def test_a_registration_cut_short_is_not_parsing_for_ever(database: Database) -> None:
    register(database)
    assert Runs(database).close("r", Stop(JobState.expired))
    resource = Resources(database).get(RESOURCE)
    assert resource.state == "refused"
    assert resource.problem is not None
    assert resource.problem["code"] == "expired"


@pytest.mark.parametrize("started", [False, True])
def test_cancelling_a_registration_settles_its_resource(database: Database, started: bool) -> None:
    begin(database)
    if started:
        Runs(database).start("r")
    Jobs(database).request_cancel("r")
    if started:
        assert Resources(database).get(RESOURCE).state == "parsing"
        Runs(database).close("r", Stop(JobState.canceled))
    resource = Resources(database).get(RESOURCE)
    assert (resource.state, (resource.problem or {})["code"]) == ("refused", "canceled")


def test_a_resource_is_never_without_its_job(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both or none are written: a resource alone would be parsing for ever."""

    def die(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(registrations, "insert_job", die)
        with pytest.raises(KeyboardInterrupt):
            begin(database)
    with pytest.raises(NotFound):
        Resources(database).get(RESOURCE)
    # and one that an earlier version left alone is taken up
    begin(database)
    with database.write() as session:
        session.execute(sa.delete(JobRow))
    assert begin(database).job is not None


def test_a_resource_is_registered_once(database: Database) -> None:
    made, again = begin(database), begin(database)
    assert (made.is_new, again.is_new) == (True, False)
    assert made.resource == again.resource
    assert made.job is not None
    assert again.job is None  # the first one's job is under way
    result = {"canonical": digest_of(b"canonical")}
    Runs(database).start("r")
    Runs(database).succeed("r", result=result, artefacts=[], progress=Progress())
    ready = begin(database)
    assert (ready.resource.state, ready.job) == ("ready", None)
    assert begin(database, again=True).resource.state == "parsing"
    assert [item.id for item in Resources(database).page(kind="mesh").items] == [RESOURCE]
    assert Resources(database).page(kind="brdf").items == []
    with pytest.raises(NotFound):
        Resources(database).get(RESOURCE, project="other")


def test_many_registrations_at_once_make_one_job(database: Database) -> None:
    n_threads = 6
    start = threading.Barrier(n_threads)
    begun: list[Begun] = []

    def run() -> None:
        start.wait()
        begun.append(begin(database))

    threads = [threading.Thread(target=run) for _ in range(n_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [one.is_new for one in begun].count(True) == 1
    assert len([one for one in begun if one.job is not None]) == 1
    assert len(begun) == n_threads


def test_keys_open_their_project_until_revoked(database: Database) -> None:
    keys = Keys(database)
    key, secret = keys.create(project="p", label="laptop")
    assert keys.verify(secret) == key
    assert keys.verify(secret + "x") is None
    with database.read() as session:
        stored = session.execute(sa.text("SELECT * FROM api_keys")).one()
    assert secret not in [str(value) for value in stored]
    assert keys.revoke(key.id)
    assert not keys.revoke(key.id)
    assert keys.verify(secret) is None


def test_a_key_that_is_replaced_is_closed(database: Database) -> None:
    keys = Keys(database)
    first = keys.replace("first", label="start")
    assert keys.replace("first", label="start") == first
    _, other = keys.create(label="laptop")
    second = keys.replace("second", label="start")
    assert (keys.verify("first"), keys.verify("second")) == (None, second)
    assert keys.is_revoked("first")
    assert not keys.is_revoked("second")
    assert not keys.is_revoked("never heard of")
    assert keys.verify(other) is not None
    # given by hand again: that is what the operator wants
    assert keys.replace("first", label="start") == first
    assert keys.verify("second") is None


def test_services_that_start_at_once_agree_on_a_key(database: Database) -> None:
    n_threads = 6
    start = threading.Barrier(n_threads)
    made: list[Key] = []

    def run() -> None:
        start.wait()
        made.append(Keys(database).replace("the same", label="start"))

    threads = [threading.Thread(target=run) for _ in range(n_threads)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert made == [made[0]] * n_threads


def test_heartbeats_age_by_the_databases_clock(database: Database) -> None:
    workers = Workers(database)
    for name in ("a", "b"):
        workers.beat(name, host="h", pid=1, tile_slots=2)
    workers.mark_gone("b")
    workers.beat("a", host="h", pid=1, tile_slots=2)
    first, second = workers.all()
    assert (first.executor_id, first.state, first.tile_slots) == ("a", "up", 2)
    assert (second.executor_id, second.state) == ("b", "gone")
    assert 0.0 <= first.age_s < 30.0
    with database.write() as session:
        session.execute(sa.text("UPDATE workers SET last_seen_s = last_seen_s - 100"))
    assert 100.0 <= workers.all()[0].age_s < 130.0
    workers.forget(["a", "b"])
    assert workers.all() == []


def test_blobs_in_use_are_known(database: Database) -> None:
    names = {
        name: digest_of(name.encode()) for name in ("up", "res", "canon", "art", "given", "old")
    }
    Uploads(database).add(names["up"], 1)
    Registrations(database).begin(RESOURCE, "mesh", {"blob": names["res"]}, parser())
    Runs(database).start("r")
    canonical = {"canonical": names["canon"], "understood": {}}
    assert Runs(database).succeed("r", result=canonical, artefacts=[], progress=Progress())
    jobs, runs = Jobs(database), Runs(database)
    jobs.create(NewJob(id="open", kind="bake", request={}, context={"mesh": names["given"]}))
    jobs.create(NewJob(id="done", kind="bake", request={"texture": names["old"]}))
    runs.start("done")
    artefact = NewArtefact("a.h5", "application/x-hdf5", names["art"], 1)
    assert runs.succeed("done", result={}, artefacts=[artefact], progress=Progress())
    assert referenced_blobs(database) == set(names.values()) - {names["old"]}


def test_moments_of_now_are_aware(database: Database) -> None:
    Jobs(database).create(NewJob(id="a", kind="bake", request={}))
    Runs(database).start("a")
    started = Jobs(database).get("a").started
    assert started is not None
    assert timedelta(0) <= datetime.now(UTC) - started < timedelta(minutes=1)
