"""Tasks and their names, the memory of results, and the arithmetic of progress."""

from datetime import timedelta
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_storage.blobs import LocalBlobStore
from prtbake_storage.queue import stages
from prtbake_storage.queue.memo import Memory, recall, remember
from prtbake_storage.queue.stages import (
    Finished,
    Measured,
    Results,
    Rounds,
    Stage,
    Task,
    package_of,
)
from prtbake_storage.queue.tally import Tally
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.runs import TaskProgress


def test_a_task_is_named_by_all_that_its_result_depends_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task = Task("m:f", {"a": 1, "b": [2.5]})
    assert Task("m:f", {"b": [2.5], "a": 1}).key == task.key
    assert (
        Task("m:f", {"a": 1, "b": [2.5]}, label="x", memory_bytes=5, cpu_seconds=1).key == task.key
    )
    others = [
        Task("m:g", {"a": 1, "b": [2.5]}),
        Task("m:f", {"a": 2, "b": [2.5]}),
        Task("m:f", {"a": "1", "b": [2.5]}),
        Task("m:f", {"a": 1, "b": [2.5]}, threads=2),
        Task("m:f", {"a": 1, "b": [2.5]}, job_started=1.5e9),
        Task("m:f", {"a": 1, "b": [2.5]}, job_started=1.6e9),
    ]
    assert len({task.key, *(other.key for other in others)}) == 7
    monkeypatch.setattr(stages, "code_version", lambda: "next")
    assert Task("m:f", {"a": 1, "b": [2.5]}).key != task.key


def test_a_task_survives_json() -> None:
    task = Task("m:f", {"a": 1}, "label", threads=2, memory_bytes=3, cpu_seconds=4)
    assert Task.from_dict(task.to_dict()) == task


def test_a_task_with_nan_has_no_name() -> None:
    with pytest.raises(ValueError, match="JSON"):
        _ = Task("m:f", {"a": float("nan")}).key


def test_results_are_entered_once() -> None:
    results = Results()
    results.add("tiles", [{"n": 1}], [Measured(2.0, 3)])
    assert dict(results) == {"tiles": [{"n": 1}]}
    assert results.measured("tiles") == [Measured(2.0, 3)]
    with pytest.raises(ValueError, match="tiles"):
        results.add("tiles", [], [])
    with pytest.raises(KeyError):
        results["join"]


@pytest.mark.parametrize("most", [3, 2])
def test_a_stage_has_no_more_rounds_than_it_says(most: int) -> None:
    """One of three rounds that says so, and one that says two."""

    def tasks(results: Results) -> list[Task]:
        n_rounds = len(results.rounds("steps"))
        return [Task("m:f", {"n": n_rounds})] if n_rounds < 3 else []

    stage = Stage("steps", "steps", 1.0, tasks, Rounds(lambda _: most, lambda _: [{"end": True}]))
    results = Results()

    def walk() -> None:
        for _ in stage.lists(results):
            results.add_round("steps", [{}], [Measured(1.0, 1)])

    if most == 3:
        walk()
        assert results["steps"] == [{"end": True}]
    else:
        with pytest.raises(RuntimeError, match="'steps' goes on after 2 rounds"):
            walk()
        assert "steps" not in results


def test_rounds_are_entered_until_the_stage_is_closed() -> None:
    results = Results()
    results.add_round("tiles", [{"n": 1}], [Measured(2.0, 3)])
    assert "tiles" not in results
    with pytest.raises(KeyError):
        results.measured("tiles")
    results.add_round("tiles", [{"n": 2}, {"n": 3}], [Measured(4.0, 5)] * 2, recalled=True)
    assert [len(done.values) for done in results.rounds("tiles")] == [1, 2]
    results.close("tiles", [{"n": 3}])
    assert results["tiles"] == [{"n": 3}]
    assert results.measured("tiles") == [Measured(2.0, 3), *[Measured(4.0, 5)] * 2]
    assert results.recalled("tiles")
    for enter in (results.add, results.add_round):
        with pytest.raises(ValueError, match="tiles"):
            enter("tiles", [], [])
    with pytest.raises(ValueError, match="tiles"):
        results.close("tiles", [])


def test_files_have_names_of_their_own() -> None:
    one, other = ("a.png", "image/png", "sha256:1"), ("b.png", "image/png", "sha256:1")
    assert len(Finished({}, [one, other]).artefacts) == 2
    with pytest.raises(ValueError, match=r"a\.png"):
        Finished({}, [one, other, one])


@pytest.fixture
def store(tmp_path: Path) -> LocalBlobStore:
    return LocalBlobStore(tmp_path)


def test_a_result_is_recalled_with_its_first_costs(store: LocalBlobStore) -> None:
    first = Memory({"n": 1}, Measured(1.5, 10))
    assert recall(store, "a" * 64) is None
    assert remember(store, "a" * 64, first) == first
    assert remember(store, "a" * 64, Memory({"n": 1}, Measured(9.0, 99))) == first
    assert recall(store, "a" * 64) == first


def test_a_result_whose_blob_is_gone_is_forgotten(store: LocalBlobStore) -> None:
    digest = store.put_bytes(b"tile")
    memory = Memory({"parts": [{"digest": digest}]}, Measured(1.0, 1))
    remember(store, "b" * 64, memory)
    assert recall(store, "b" * 64) == memory
    store.delete(digest)
    assert recall(store, "b" * 64) is None
    assert store.get_result("b" * 64) is None


def tally(*weights: float) -> Tally:
    kinds = [
        Stage(f"s{index}", "tiles", weight, lambda _: []) for index, weight in enumerate(weights)
    ]
    return Tally(kinds, utc_now() - timedelta(seconds=10.0), 0.0)


def test_progress_adds_up_by_weight() -> None:
    progress = tally(3.0, 1.0)
    half = progress.at(0, 1, 2, [])
    assert half.fraction == pytest.approx(0.375)
    assert (half.stage, half.stage_index, half.stage_count) == ("s0", 0, 2)
    assert (half.done, half.total, half.unit) == (1, 2, "tiles")
    assert half.elapsed_s >= 10.0
    running = [TaskProgress(1, 5.0, 10.0, "rows")]
    assert progress.at(0, 1, 2, running).fraction == pytest.approx(0.5625)
    assert progress.at(1, 0, 1, []).fraction == pytest.approx(0.75)
    assert progress.finished().fraction == 1.0


def test_a_single_long_task_counts_in_its_own_unit() -> None:
    progress = tally(1.0).at(0, 0, 1, [TaskProgress(0, 30.0, 120.0, "iterations")])
    assert (progress.done, progress.total, progress.unit) == (30.0, 120.0, "iterations")
    assert progress.fraction == pytest.approx(0.25)


def test_rounds_share_the_progress_of_their_stage() -> None:
    progress = tally(1.0, 1.0)
    now = progress.at(0, 1, 2, [], rounds=(3, 10))
    assert (now.done, now.total, now.unit) == (3, 10, "rounds")
    assert now.fraction == pytest.approx(0.5 * 0.35)
    # the last of them came early
    assert progress.at(1, 0, 1, []).fraction == pytest.approx(0.5)


def test_a_stage_without_tasks_is_done() -> None:
    assert tally(1.0, 1.0).at(0, 0, 0, []).fraction == pytest.approx(0.5)


def test_a_job_without_weight_does_not_divide_by_zero() -> None:
    assert tally(0.0).at(0, 0, 4, []).fraction == 0.0


@given(
    weights=st.lists(st.floats(0.0, 100.0), min_size=1, max_size=5),
    steps=st.lists(
        st.tuples(st.integers(0, 4), st.integers(0, 9), st.floats(0.0, 50.0)), max_size=20
    ),
)
def test_the_fraction_never_falls_and_stays_in_range(
    weights: list[float], steps: list[tuple[int, int, float]]
) -> None:
    progress = tally(*weights)
    last = 0.0
    for stage, done, part in steps:
        # even from a task that claims to be beyond its end, or tiles that were lost and come again
        now = progress.at(stage % len(weights), done, 9, [TaskProgress(9, part, 10.0, "")])
        assert last <= now.fraction <= 1.0
        assert now.eta_s is None or now.eta_s >= 0.0
        last = now.fraction


@pytest.mark.parametrize(("module", "package"), [("kinds", "kinds"), ("a.b.registry", "a.b")])
def test_tasks_lie_in_the_package_of_their_job_kinds(module: str, package: str) -> None:
    runner = type("Registry", (), {"__module__": module})()
    assert package_of(runner) == package
