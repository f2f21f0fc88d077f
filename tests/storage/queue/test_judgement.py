"""When a worker may declare others dead, and what it waits out."""

import threading
import time

import pytest
from sqlalchemy.exc import IntegrityError, OperationalError

from prtbake_storage.contract.jobs import JobError
from prtbake_storage.errors import ResourceExhausted
from prtbake_storage.queue import heart as heart_module
from prtbake_storage.queue import patience
from prtbake_storage.queue.failures import TaskFailed, TaskStopped, describe, may_pass
from prtbake_storage.queue.heart import Heart
from prtbake_storage.queue.patience import patiently
from prtbake_storage.queue.settings import QueueSettings, new_executor_id


class Clock:
    """A clock that the test turns."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now


class Beats:
    """Stands for the table of workers, which may be away."""

    def __init__(self) -> None:
        self.n = 0

    def beat(self, *_args: object, **_fields: object) -> None:
        self.n += 1


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(heart_module, "time", clock)
    return clock


def test_nobody_is_judged_before_ones_own_beats_were_steady(clock: Clock) -> None:
    settings = QueueSettings(heartbeat_s=1.0, dead_after_s=10.0)
    heart = Heart(Beats(), "me", settings)  # type: ignore[arg-type]
    judged = []
    for _ in range(12):
        clock.now += 1.0
        heart.beat()
        judged.append(heart.may_judge)
    assert judged == [False] * 10 + [True] * 2
    # the database was away: everybody's beats are old now, and that says nothing
    clock.now += 20.0
    assert not heart.may_judge
    heart.beat()
    judged = []
    for _ in range(12):
        clock.now += 1.0
        heart.beat()
        judged.append(heart.may_judge)
    assert judged == [False] * 10 + [True] * 2


def test_a_passing_outage_is_waited_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(patience, "RETRY_S", 0.01)
    stop, calls = threading.Event(), []

    def call(value: int) -> int:
        calls.append(value)
        if len(calls) < 3:
            raise OperationalError("SELECT 1", {}, Exception("away"))
        return value

    assert patiently(stop, call, 5) == 5
    assert calls == [5, 5, 5]


def test_a_lasting_error_is_not_waited_out() -> None:
    def call() -> None:
        raise IntegrityError("INSERT", {}, Exception("twice"))

    with pytest.raises(IntegrityError):
        patiently(threading.Event(), call)


def test_a_leaving_worker_does_not_wait_for_the_database() -> None:
    stop = threading.Event()
    stop.set()

    def call() -> None:
        raise OperationalError("SELECT 1", {}, Exception("away"))

    begin = time.monotonic()
    with pytest.raises(TaskStopped) as caught:
        patiently(stop, call)
    assert caught.value.reason == "shutdown"
    assert time.monotonic() - begin < 5.0


def test_errors_are_told_in_the_words_of_the_wire() -> None:
    assert describe(MemoryError()).code == "out-of-memory"
    assert describe(OSError(28, "No space left on device")).code == "disk-full"
    assert describe(OSError(2, "No such file")).kind == "internal"
    assert describe(OSError(116, "Stale file handle")).code == "io-error"
    failed = JobError(kind="resource", code="task-died", detail="killed")
    assert describe(TaskFailed(failed)) == failed
    assert (
        describe(ZeroDivisionError("division by zero")).detail
        == "ZeroDivisionError: division by zero"
    )


class Passing(ResourceExhausted):
    retryable = True


@pytest.mark.parametrize(
    ("error", "passes"),
    [
        (OSError(5, "Input/output error"), True),
        (OSError(116, "Stale file handle"), True),
        (BlockingIOError(11, "Resource temporarily unavailable"), True),
        (ConnectionResetError("without a number"), True),
        (TimeoutError("without a number"), True),
        (Passing("not yet"), True),
        (TaskFailed(describe(MemoryError()), retryable=True), True),
        (TaskFailed(describe(MemoryError())), False),
        (OSError(28, "No space left on device"), False),
        (OSError(12, "Cannot allocate memory"), False),
        (PermissionError(13, "Permission denied"), False),
        (FileNotFoundError(2, "No such file"), False),
        (ResourceExhausted("for good"), False),
        (ValueError("a bug"), False),
    ],
)
def test_what_may_pass_is_known_by_kind_and_number(error: Exception, *, passes: bool) -> None:
    assert may_pass(error) == passes


def test_settings_travel_through_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = QueueSettings(poll_s=0.125, tile_slots=3, database_url="sqlite:////x/y.sqlite")
    for name, value in settings.to_env().items():
        monkeypatch.setenv(name, value)
    assert QueueSettings() == settings


def test_the_urls_follow_from_the_data_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DATABASE_URL", "BLOB_URL", "DATA_DIR"):
        monkeypatch.delenv(f"PRTBAKE_{name}", raising=False)
    settings = QueueSettings(data_dir="/srv/prt bake")
    assert settings.database_url == "sqlite:////srv/prt bake/prtbake.sqlite"
    assert settings.blob_url == "file:///srv/prt%20bake/blobs"


def test_every_start_has_a_name_of_its_own() -> None:
    assert len({new_executor_id() for _ in range(100)}) == 100
