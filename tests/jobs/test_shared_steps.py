"""A tensor approximation whose steps are shared by tasks, against one task that makes them all."""

import pytest
from pydantic import ValidationError

from prtbake_storage.contract.settings import CompressSettings
from prtbake_storage.queue.stages import Measured, Results, Round, Task
from prtbake_workers.compress.monotone import ObjectiveRose
from prtbake_workers.jobs.compress import standalone_stages
from prtbake_workers.jobs.cta_course import OneTask, SharedSteps, course, most_rounds, shares
from prtbake_workers.jobs.report import gather
from prtbake_workers.planning.fan_out import MOST_TASKS, tasks_a_step
from support.local_stages import run_stages
from support.transfer_file import write_transfer

SIZES = {"max_iterations": 4, "n_clusters": 7, "ranks": (4, 24, 12), "n_components": 6}
PAPER = {"n_verts": 34834, "n_rows": 8, "n_coeffs": 642, "n_clusters": 97, "light": 48, "vert": 24}


@pytest.mark.parametrize(
    ("n_channels", "step_tasks", "settings"),
    [
        (1, 3, {"coherence": 0.05, "overdraw_budget": 0.1}),
        (3, 2, {"classification": "adaptive"}),
        (1, 64, {"max_iterations": 1}),
    ],
    ids=["overdraw", "coloured", "one iteration"],
)
def test_factors_are_the_same_whoever_makes_the_steps(
    store, tmp_path, n_channels, step_tasks, settings
):
    transfer = store.put_file(write_transfer(tmp_path, n_channels=n_channels))

    def run(step_tasks: int) -> Results:
        asked = CompressSettings(**SIZES | settings, step_tasks=step_tasks)
        return run_stages(standalone_stages(transfer, asked, 1)[:2], store)

    whole, made = run(1), run(step_tasks)
    assert len(whole.rounds("compress")) == 1
    assert made["compress"] == whole["compress"]
    rounds = [len(one.values) for one in made.rounds("compress")]
    # start beside the diffuse part, then steps, then finish
    assert (rounds[0], rounds[-1], set(rounds[1:-1])) == (2, 1, {min(step_tasks, 7)})
    assert 5 <= len(rounds) <= most_rounds((SIZES | settings)["max_iterations"])
    # the report counts them as one stage
    (told,) = [one for one in gather("", made)["stages"] if one["name"] == "compress"]
    assert told["tiles"] == sum(rounds)
    assert told["seconds"] == pytest.approx(sum(c.seconds for c in made.measured("compress")))


def test_the_asset_does_not_tell_who_made_it(store, tmp_path):
    transfer = store.put_file(write_transfer(tmp_path, n_channels=1))

    def run(step_tasks: int, n_clusters: int) -> dict:
        sizes = SIZES | {"n_clusters": n_clusters, "max_iterations": 2}
        asked = CompressSettings(**sizes, step_tasks=step_tasks)
        (made,) = run_stages(standalone_stages(transfer, asked, 1), store)["quantise"]
        return made

    whole, shared = run(1, 5), run(2, 5)
    assert shared == whole
    assert run(2, 4)["asset"] != whole["asset"]


def test_beside_an_error_that_is_asked_for_one_task_makes_them_all(store, tmp_path):
    transfer = store.put_file(write_transfer(tmp_path, n_channels=1))
    asked = CompressSettings(n_clusters=4, max_error=0.3, step_tasks=3)
    (plan,) = run_stages(standalone_stages(transfer, asked, 1)[:1], store)["plan"]
    assert [part["compression"]["tasks"] for part in plan["plan"]["parts"]] == [1, 1]
    free = asked.model_copy(update={"max_error": None})
    (plan,) = run_stages(standalone_stages(transfer, free, 1)[:1], store)["plan"]
    # the other part is diffuse
    assert [part["compression"]["tasks"] for part in plan["plan"]["parts"]] == [3, 1]


def test_more_processes_than_steps_are_worth_are_refused():
    assert CompressSettings(step_tasks=64).step_tasks == 64
    assert CompressSettings(step_tasks=1, max_iterations=200).step_tasks == 1
    assert CompressSettings(step_tasks=10, max_iterations=200).step_tasks == 10
    for tasks, iterations in ((64, 200), (11, 200), (64, 30)):
        with pytest.raises(ValidationError, match=f"step_tasks {tasks} .* 4096 at most") as refused:
            CompressSettings(step_tasks=tasks, max_iterations=iterations)
        (error,) = refused.value.errors()
        assert error["loc"] == ("step_tasks",)


def test_clusters_are_cut_into_runs_without_an_empty_one():
    for n_clusters, n_tasks in ((7, 3), (7, 7), (7, 64), (1, 2), (97, 10)):
        runs = shares(n_clusters, n_tasks)
        assert len(runs) == min(n_clusters, n_tasks)
        assert [i for start, stop in runs for i in range(start, stop)] == list(range(n_clusters))
        sizes = [stop - start for start, stop in runs]
        assert max(sizes) - min(sizes) <= 1


def test_steps_are_shared_where_that_pays():
    """The papers' bunny has about a second of work a step, eight of its size have tasks to share."""
    assert tasks_a_step(**PAPER) == 1
    larger = PAPER | {"n_verts": 8 * 34834, "n_clusters": 776}
    assert 8 < tasks_a_step(**larger) <= MOST_TASKS
    assert tasks_a_step(**larger | {"n_verts": 10**7}) == MOST_TASKS
    assert tasks_a_step(**PAPER | {"n_verts": 10**7, "n_clusters": 2}) == 2


def walked(part: SharedSteps, n_moved: list[int], errors: list[float]) -> list[str]:
    """Answer every step with these numbers; give the functions that were asked for, by round."""
    left, moved, asked = iter(errors), iter(n_moved), []
    while tasks := part.tasks():
        name = tasks[0].function.rpartition(":")[2]
        asked.append(name)
        error = next(left) if name in ("model", "approximate") else 0.0
        fitted = {"model": "m", "objectives": [0.5 * error]}
        values = {
            "start": {"n_clusters": 4, "squared_norm": 1.0},
            "model": fitted,
            "approximate": fitted,
            "classify": {"moves": "x", "moved": next(moved) if name == "classify" else 0},
            "view": {"view": "v"},
            "finish": {"name": "done"},
        }
        part.take([values[name] for _ in tasks])
    return asked


def shared_steps(**args) -> SharedSteps:
    return SharedSteps(Task("m:f", {"max_iterations": 5, **args}, "part 0", threads=2), 2)


def test_steps_follow_each_other_as_in_one_task():
    part = shared_steps()
    asked = walked(part, [3, 0], [0.9, 0.5, 0.4, 0.3, 0.2])
    # two model steps until nobody moves, then three times view and bases
    last = ["view", "approximate"] * 3
    assert asked == ["start", "model", "classify", "model", "classify", *last, "finish"]
    assert part.result == {"name": "done"}
    # a step that wins less than a thousandth is its phase's last
    few = walked(shared_steps(), [3], [0.9, 0.8999, 0.8998])
    assert few == ["start", "model", "classify", "model", "view", "approximate", "finish"]
    many = walked(shared_steps(), [1] * 4, [0.9 - 0.1 * i for i in range(8)])
    assert many.count("model") == 5
    assert len(many) == most_rounds(5)


def test_an_error_that_rises_is_a_fault():
    with pytest.raises(ObjectiveRose):
        walked(shared_steps(), [3], [0.5, 0.6])


def test_parts_of_both_kinds_go_side_by_side():
    wholes = [Task("m:f", {"max_iterations": 5, "part": index}) for index in range(2)]
    parts = course(wholes, [1, 2], [])
    assert [type(part) for part in parts] == [OneTask, SharedSteps]
    asked = [task.function for part in parts for task in part.tasks()]
    assert asked == ["m:f", "prtbake_workers.jobs.cta_tiles:start"]
    done = [{"name": "one"}, {"n_clusters": 4, "squared_norm": 1.0}]
    one, other = course(wholes, [1, 2], [Round(done, [Measured(1.0, 1)] * 2)])
    assert (one.result, one.tasks()) == ({"name": "one"}, [])
    assert [task.args["clusters"] for task in other.tasks()] == [[0, 2], [2, 4]]
