"""The table and the page of budgets: what goes on, what holds, and what does not."""

import time

import pytest

from measured.budgets import NAMES, asked_of, so_far
from measured.budgets_table import ERROR, TIME, Row, page, statements
from measured.rows import append_rows, read_rows
from prtbake_storage.blobs.opening import open_store
from prtbake_storage.queue.stages import Results, Stage
from prtbake_workers.jobs import clock
from support.local_stages import run_stage

GOOD = [Row("ball", ERROR, 0.1, error, 1000, 5.0, "as asked") for error in (0.061, 0.08, 0.099)]
IN_TIME = [
    *(Row("ball", TIME, asked, None, 900, 1.09 * asked, "quality low") for asked in range(30, 39)),
    Row("ball", TIME, 3.0, None, 0, 3.2, "refused"),
]


def test_promises_that_are_kept_are_told_as_kept():
    assert all(holds for holds, _ in statements([*GOOD, *IN_TIME]))
    text = page([*GOOD, *IN_TIME], about="Jobs.", machine="Measured here.")
    assert "does not hold" not in text
    assert "| ball | 10 % | 6.1 % | 0.61 | 1 kB | 5 |" in text


@pytest.mark.parametrize(
    ("rows", "broken"),
    [
        ([*GOOD, Row("ball", ERROR, 0.1, 0.1001, 1000, 5.0), *IN_TIME], 0),
        ([*GOOD[:2], Row("ball", ERROR, 0.1, 0.059, 1000, 5.0), *IN_TIME], 1),
        ([*GOOD[:2], Row("ball", ERROR, 0.1, None, 0, 5.0, "cannot be met"), *IN_TIME], 1),
        ([*GOOD, Row("ball", TIME, 30.0, None, 900, 33.1, "quality low")], 2),
        # a refusal takes no longer than was asked for either, and is no way to keep times
        ([*GOOD, *IN_TIME[:-1], Row("ball", TIME, 3.0, None, 0, 3.4, "refused")], 2),
        ([*GOOD, *IN_TIME[1:], IN_TIME[-1]], 2),
    ],
)
def test_the_promise_that_is_broken_is_told(rows, broken):
    failed = [index for index, (holds, _) in enumerate(statements(rows)) if not holds]
    assert failed == [broken]
    assert page(rows, about="", machine="").count("does not hold") == 1


def test_the_table_goes_on_where_it_was_left(tmp_path):
    path = tmp_path / "budgets.csv"
    assert read_rows(path, Row) == []
    rows = [GOOD[0], Row("ball", ERROR, 0.01, None, 0, 5.0, 'no, "never"'), IN_TIME[0]]
    for row in rows:
        append_rows(path, [row], Row)
    assert read_rows(path, Row) == rows
    assert [row.key for row in rows] == [
        ("ball", ERROR, 0.1), ("ball", ERROR, 0.01), ("ball", TIME, 30.0),
    ]  # fmt: skip


def test_there_are_forty_errors_and_twenty_times():
    keys = [key for name in NAMES for key in asked_of(name, quick=False)]
    assert len(set(keys)) == len(keys)
    assert [sum(key[1] == what for key in keys) for what in (ERROR, TIME)] == [40, 20]


def test_the_page_says_how_much_of_it_is_there():
    known = [Row(*key, 0.1, 1000, 5.0) for key in asked_of("spot", quick=False)]
    assert so_far([*known, *GOOD]).startswith(f"{len(known)} of 60 ")


def test_shared_tasks_run_once_and_take_what_they_took(tmp_path):
    """The clock's answer is another one every time that it is asked."""
    store, results = open_store((tmp_path / "blobs").as_uri()), Results()
    task = clock.task(time.time(), "here")
    for name, shared in (("a", True), ("b", True), ("c", False)):
        stage = Stage(name, "", 1.0, lambda _: [task])
        run_stage(stage, results, store, shared=(task.function,) if shared else ())
    assert results["a"] == results["b"] != results["c"]
    assert results.measured("b")[0].seconds >= results.measured("a")[0].seconds > 0.0
