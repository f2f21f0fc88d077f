"""The draws and the page of the cost model."""

import pytest

from measured.cost_jobs import FIRST_SEED, TRAINING_SEED, Draw
from measured.cost_table import (
    BYTES,
    MEMORY,
    SECONDS,
    STAGES,
    Row,
    off_by,
    page,
    share_within,
    statements,
)
from measured.rows import append_rows, read_rows
from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.contract.resources import EnvironmentRegistration, MeshRegistration


def rows_of(factor, n_jobs=10):
    """All figures of some jobs, of which the last is predicted so far off."""
    return [
        Row(job, "scene", what, of, 100.0 * (factor if job == n_jobs - 1 else 1.0), 100.0)
        for job in range(n_jobs)
        for what, of in ((SECONDS, "job"), (STAGES, "bake"), (BYTES, "a"), (BYTES, "b"),
                         (MEMORY, "job"))
    ]  # fmt: skip


def test_every_draw_is_a_legal_request_and_its_own():
    bodies = []
    for number in range(40):
        draw = Draw.of(number)
        MeshRegistration.model_validate({"builtin": draw.mesh})
        EnvironmentRegistration.model_validate({"builtin": draw.environment})
        names = {"mesh": f"mesh-{'0' * 16}", "environment": f"environment-{'0' * 16}"}
        bodies.append(job_request_adapter.validate_python(draw.request | names))
        assert Draw.of(number) == draw
        assert Draw.of(number, first_seed=1) != draw
    assert len({body.model_dump_json() for body in bodies}) == 40
    assert {body.quality for body in bodies} == {"draft", "low", "medium"}


@pytest.mark.parametrize("factor", [1.1, 1.0 / 1.1])
def test_a_job_is_off_by_its_worst_figure_whichever_way(factor):
    rows = [row for row in rows_of(factor) if row.what == BYTES]
    assert off_by(rows)[9] == pytest.approx(1.1)
    assert share_within(rows, 1.09) == 0.9
    assert share_within(rows, 1.11) == 1.0


def test_statements_hold_for_nine_of_ten_jobs_and_no_fewer():
    assert all(holds for _, holds in statements(rows_of(9.0)))
    two_off = [*rows_of(9.0), *(row for row in rows_of(9.0, 1) if row.what == MEMORY)]
    held = {text.split(" within")[0]: holds for text, holds in statements(two_off)}
    assert held == {SECONDS: True, BYTES: True, MEMORY: False}


def test_the_page_holds_the_rows():
    text = page(rows_of(1.25), about="About.", machine="A machine.")
    assert "10 jobs" in text
    assert text.count("- holds") == 3
    assert "| bytes | a | 10 | 1.00 | 1.00 | 1.00 | 1.00 | 1.14 |" in text


def test_the_table_grows_piece_by_piece(tmp_path):
    table = tmp_path / "rows.csv"
    assert read_rows(table, Row) == []
    rows = rows_of(1.1 / 3.0)
    append_rows(table, rows[:7], Row)
    append_rows(table, rows[7:], Row)
    assert read_rows(table, Row) == rows
    # a job of its own is one that no earlier piece ran
    assert {row.job for row in read_rows(table, Row)} == set(range(10))


def test_training_jobs_are_none_of_those_held_out():
    held = {Draw.of(number).request["seed"] for number in range(200)}
    assert held == set(range(200))
    training = [Draw.of(number, first_seed=TRAINING_SEED) for number in range(200)]
    assert TRAINING_SEED + len(training) < FIRST_SEED
    assert not any(one == Draw.of(one.number) for one in training)
