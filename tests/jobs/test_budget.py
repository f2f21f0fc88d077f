"""Assets with a budget through the real stages, in this process: what is tried, and what is left."""

import copy
import json
import signal
import time

import numpy as np
import pytest

from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.contract.settings import Camera, ValidateSettings
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs import clock, leaving, tuning
from prtbake_workers.jobs.budget import search_of
from prtbake_workers.jobs.estimate import predict
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.search_stages import limit
from prtbake_workers.planning.error_search import WINDOW
from prtbake_workers.planning.rates import BETWEEN_STAGES_S
from prtbake_workers.planning.time_search import MARGIN
from prtbake_workers.report.account import pooled_budget
from support.budgeted import LEFT_OPEN, begun, normal
from support.local_stages import run_stage, run_stages

TARGET = 0.25
NO_BOUNCES = {"interreflection": "off"}


def run(store, request, context):
    return run_stages(REGISTRY.stages("asset", request, context), store)


@pytest.fixture(scope="module")
def met(store):
    """An error that the lowest step meets with room."""
    request = normal({"max_error": TARGET})
    context = begun(store, request)
    results = run(store, request, context)
    return request, context, results, REGISTRY.finish("asset", request, context, results)


def test_room_is_spent_on_compression_until_the_aim_is_near(met):
    *_, finished = met
    bakes, lights, compressions = (
        [one for one in finished.result["search"]["attempts"] if one["name"].startswith(kind)]
        for kind in ("bake", "light", "compression")
    )
    assert [one["name"] for one in bakes] == ["bake, draft"]
    assert bakes[0]["error"] < 0.5 * TARGET
    assert lights[-1]["taken"]
    (taken,) = (one for one in compressions if one["taken"])
    aim = finished.result["search"]["aim"]
    assert 0.6 * TARGET < aim < 0.9 * TARGET
    # of those that stayed below the aim it errs by most
    below = [one["error"] for one in compressions if one["error"] <= WINDOW[1] * aim]
    assert 0.8 * aim < taken["error"]
    assert taken["error"] == max(below)
    assert all(one["why"] and one["seconds"] > 0 for one in compressions)


def test_held_out_views_err_by_less_than_the_target(met, store):
    *_, results, finished = met
    views = [view for camera in results["validate 1"] for view in camera["views"]]
    total = pooled_budget(views)["total"]
    assert 0.0 < total <= TARGET
    assert finished.result["budget"]["total"] == total


def test_what_is_delivered_is_the_attempt_that_was_taken(met, store):
    request, _, results, finished = met
    files = {file.name: file.digest for file in finished.artefacts}
    taken = [one for one in finished.result["search"]["attempts"] if one["taken"] and one["bytes"]]
    assert (
        taken[-1]["bytes"] == store.size(files["asset.h5"]) == finished.result["bytes"]["asset.h5"]
    )
    asked = float(taken[-1]["name"].split()[-1])
    asset = read_asset(store.local_path(files["asset.h5"]))
    assert asset.provenance["compress"]["max_error"] == pytest.approx(asked, rel=1e-2)
    assert asset.provenance["transfer"] == files["transfer.h5"]
    assert reconstruct(asset.parts[0], slice(None)).any()
    page = store.read_bytes(files["report.html"]).decode()
    assert "What was tried for the budget" in page
    assert "max_error 0.25" in page
    report = json.loads(store.read_bytes(files["report.json"]))
    assert report["search"]["budget"] == request["budget"]
    # it has a place on the frontier, beside another bake with its light and compression
    own, (step,) = report["frontier"]["asset"], report["frontier"]["steps"]
    assert own["error"] == finished.result["budget"]["total"]
    assert step["quality"] == "low"
    assert step["lines"]["light fit"] == own["lines"]["light fit"]
    assert step["lines"]["compression"] == own["lines"]["compression"] > 0.0
    # what was left has cost something too
    spent = sum(
        cost.seconds for name in results for cost in results.measured(name) if name != "report"
    )
    assert report["seconds"]["total"] == pytest.approx(spent)


def test_an_error_that_no_step_meets_is_refused_with_the_best(store):
    """Shadows of a coarse plane: interpolation between its vertices, which no setting changes."""
    request = normal({"max_error": 0.002}, receiver={"resolution": 6}, effects=NO_BOUNCES)
    with pytest.raises(SettingsError, match=r"0\.20% cannot be met: at best (\d+\.\d+)%") as raised:
        run(store, request, begun(store, request))
    assert raised.value.pointer == "/budget/max_error"
    assert "vertex interpolation, which a finer mesh or receiver would lower" in str(raised.value)


@pytest.mark.parametrize("budget", [{}, {"max_error": TARGET}])
def test_a_second_is_too_short_and_the_error_tells_the_least(store, budget):
    request = normal({"max_seconds": 1.0} | budget)
    with pytest.raises(
        SettingsError, match=r"1 s are too few: .* predicted to take \d+ s"
    ) as raised:
        run(store, request, begun(store, request))
    assert raised.value.pointer == "/budget/max_seconds"


@pytest.fixture(scope="module")
def timed(store):
    """The steps of a ladder whose bakes are pinned: they differ in light and compression."""
    request = normal({"max_seconds": 200.0})
    context = begun(store, request)
    results = run(store, request, context)
    return request, context, results, REGISTRY.finish("asset", request, context, results)


def test_the_best_step_that_time_allows_is_delivered(timed, store):
    *_, finished = timed
    attempts = finished.result["search"]["attempts"]
    assert attempts[0]["name"] == "quality draft"
    assert [one["taken"] for one in attempts] == [False] * (len(attempts) - 1) + [True]
    assert len(attempts) > 1
    assert finished.result["metrics"]
    files = {file.name: file.digest for file in finished.artefacts}
    assert set(files) >= {"asset.h5", "report.html"}
    beside = json.loads(store.read_bytes(files["report.json"]))["frontier"]["steps"]
    made = attempts[-1]["name"].split()[-1]
    assert beside
    assert made not in [step["quality"] for step in beside]


def test_an_attempt_that_runs_late_is_given_up_and_the_one_before_delivered(timed, store):
    """The same job when the clock says, after its first attempt, that there was time for another,
    and the tasks of that one find that there is none."""
    request, context, results, _ = timed
    late = Results()
    left = list(REGISTRY.stages("asset", request, context))
    while not left[0].name.startswith("bake 2"):
        name = left.pop(0).name
        late.add(name, results[name], results.measured(name))
    late.add("bake 2", [leaving.LATE], results.measured("bake 2"))
    for stage in left[1:]:
        run_stage(stage, late, store)
    finished = REGISTRY.finish("asset", request, context, late)
    attempts = finished.result["search"]["attempts"]
    assert [one["taken"] for one in attempts] == [True, False]
    assert attempts[1]["why"] == "given up: its time was out"
    files = {file.name: file.digest for file in finished.artefacts}
    assert files["asset.h5"] == results["quantise 1"][0]["asset"]


def test_tasks_leave_when_their_time_is_out(store):
    """A task that would take seconds leaves at once; one that has time does its work."""
    request = normal({"max_seconds": 3600.0})
    context = begun(store, request)
    (stage,) = [s for s in REGISTRY.stages("asset", request, context) if s.name == "plan 1"]
    results = Results()
    run_stage(
        limit(Stage("a", "", 1.0, lambda _: stage.tasks(Results())), lambda _: 0.0, context),
        results,
        store,
    )
    assert results["a"] == [leaving.LATE]
    began = time.time()

    def napping(_):
        return [Task("prtbake_workers.jobs.clock:look", {"started": began, "place": "nap"})]

    run_stage(limit(Stage("b", "", 1.0, napping), lambda _: began + 60.0, context), results, store)
    assert results["b"][0]["elapsed"] >= 0.0


def test_a_task_that_starts_late_imports_nothing(store):
    """Sixty tiles may be left, and an import takes most of a second."""
    args = {"function": "prtbake_workers.jobs.nowhere:run", "args": {}}
    with store.scratch() as scratch:
        context = TaskContext(store, scratch, lambda _: None)
        assert leaving.run(args | {"when": time.time()}, context) == leaving.LATE
        with pytest.raises(ModuleNotFoundError):
            leaving.run(args | {"when": time.time() + 60.0}, context)


@pytest.mark.parametrize(("slots", "starts"), [(None, [4, 3, 2, 1, 0]), (2, [2, 1, 1, 0, 0])])
def test_tasks_leave_early_enough_for_those_after_them_to_start(slots, starts):
    """The last in every slot has all of the time."""
    tasks = [clock.task(0.0, str(place)) for place in range(5)]
    context = {} if slots is None else {"tile_slots": slots}
    stage = limit(Stage("a", "", 1.0, lambda _: tasks), lambda _: 100.0, context)
    ends = [task.args["when"] for task in stage.tasks(Results())]
    assert ends == pytest.approx([100.0 - MARGIN * BETWEEN_STAGES_S * after for after in starts])
    assert limit(stage, lambda _: None, context).tasks(Results()) == stage.tasks(Results())


class Stubborn:
    """Swallows what is raised while it is dropped, as Python does in every finaliser."""

    def __del__(self):
        time.sleep(1.0)


def drop_and_go_on(args, _):
    """A task that is in a finaliser when its time is out, and then has a minute to do."""
    stubborn = Stubborn()
    del stubborn
    for _ in range(600):
        time.sleep(0.1)
    return args


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_alarm_that_is_swallowed_comes_again(store, monkeypatch):
    before = signal.getsignal(signal.SIGALRM)
    monkeypatch.setattr(clock, "look", drop_and_go_on)
    monkeypatch.setattr(leaving, "AGAIN_S", 0.2)
    began = time.time()
    args = {"function": "prtbake_workers.jobs.clock:look", "args": {}, "when": began + 0.3}
    with store.scratch() as scratch:
        context = TaskContext(store, scratch, lambda _: None)
        assert leaving.run(args, context) == leaving.LATE
    assert time.time() - began < 20.0
    # neither alarm nor handler is left behind
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert signal.getsignal(signal.SIGALRM) == before


def test_the_clock_tells_the_seconds_since_the_start(store):
    results = Results()
    began = time.time() - 5.0
    run_stage(Stage("c", "", 1.0, lambda _: [clock.task(began, "here")]), results, store)
    assert 5.0 <= results["c"][0]["elapsed"] < 15.0


def test_an_estimate_is_of_the_first_attempt_and_says_so(store):
    request = normal({"max_error": 0.05, "max_seconds": 0.5})
    parsed = job_request_adapter.validate_python(request)
    found = predict(parsed, request, begun(store, request), store)
    first, short = found.warnings[-2:]
    assert "searched from quality draft on" in first
    assert "reference" in first
    assert short.startswith("budget.max_seconds: 0.5 s are too few")
    # a quality has no search to warn of
    plain = request | {"budget": None, "quality": "draft"}
    of_draft = predict(
        job_request_adapter.validate_python(plain), plain, begun(store, plain), store
    )
    assert not any("budget" in one for one in of_draft.warnings)
    assert of_draft.total_seconds == pytest.approx(found.total_seconds)


def test_tuning_looks_where_the_validation_does_not():
    settings = ValidateSettings(
        cameras=[Camera(), Camera(name="inside", eye=(0.0, 0.0, 2.0), target=(0.0, 0.0, 0.0))],
        rotations_deg=[(0.0, 21.0, 0.0), (0.0, 66.5, 0.0)],
    )
    views = tuning.tuning_views(settings)
    turns = [turn for _, own in views for turn in own]
    assert len(set(turns)) == 8
    assert not set(turns) & set(settings.rotations_deg)
    assert len({camera.azimuth_deg for camera, _ in views if camera.eye is None}) == 2
    assert all(camera not in settings.cameras for camera, _ in views)
    eyes = [np.array(camera.eye) for camera, _ in views if camera.eye is not None]
    # about what it looks at, as far off as it was, and not far away: it may stand in a room
    assert all(np.linalg.norm(eye) == pytest.approx(2.0) for eye in eyes)
    assert all(0.1 < np.linalg.norm(eye - [0.0, 0.0, 2.0]) < 1.5 for eye in eyes)


def test_a_search_that_is_out_of_time_delivers_what_meets_the_error(met, store):
    """The same search where a later compression left: what was measured before it counts."""
    request, context, results, _ = met
    pressed = request | {"budget": request["budget"] | {"max_seconds": 6e5}}
    late = Results()
    stages = REGISTRY.stages("asset", pressed, context)
    last = max(
        int(name.split()[1]) for name in results if name.startswith("compress ") and results[name]
    )
    names = [stage.name for stage in stages]
    cut = names.index(f"measure asset {last}")
    for name in names[:cut]:
        late.add(name, results[name], results.measured(name))
    late.add(names[cut], [leaving.LATE], results.measured(names[cut])[:1])
    before = [late.get(f"measure asset {at}") for at in range(1, last)]
    assert any(before)
    for stage in stages[cut + 1 :]:
        run_stage(stage, late, store)
    finished = REGISTRY.finish("asset", pressed, context, late)
    assert finished.result["budget"]["total"] <= TARGET
    taken = [one for one in finished.result["search"]["attempts"] if one["taken"]]
    assert taken[-1]["error"] <= WINDOW[1] * finished.result["search"]["aim"]
    # the settings are those of what is delivered, not of what was tried last
    files = {file.name: file.digest for file in finished.artefacts}
    told = json.loads(store.read_bytes(files["report.json"]))["settings"]["compress"]["max_error"]
    assert (
        told == read_asset(store.local_path(files["asset.h5"])).provenance["compress"]["max_error"]
    )
    assert float(taken[-1]["name"].split()[-1]) == pytest.approx(told, rel=1e-2)


def test_a_search_that_is_out_of_time_with_nothing_fails_by_the_time(met):
    request, context, results, _ = met
    late = Results()
    for name in ("plan 1", "bake 1", "scattering 1", "bounces 1", "add_bounces 1"):
        late.add(name, results[name], results.measured(name))
    late.add("join 1", [leaving.LATE], results.measured("join 1"))
    pressed = request | {"budget": request["budget"] | {"max_seconds": 6e5}}
    stages = {stage.name: stage for stage in REGISTRY.stages("asset", pressed, context)}
    with pytest.raises(SettingsError, match=r"are too few for an error of 25\.00%") as raised:
        stages["fit_light 1"].tasks(late)
    assert raised.value.pointer == "/budget/max_seconds"


def test_an_error_and_a_time_need_no_settings_of_the_validation(store):
    """Its samples are not known before the first measurement, and tasks before it leave too."""
    settings = LEFT_OPEN | {"validation": {"width": 32, "height": 24}}
    request = normal({"max_error": TARGET, "max_seconds": 6e5}, settings=settings)
    context = begun(store, request)
    stages = {stage.name: stage for stage in REGISTRY.stages("asset", request, context)}
    results = Results()
    run_stage(stages["plan 1"], results, store)
    tasks = stages["bake 1"].tasks(results)
    assert tasks
    ends = context["started"] + 6e5
    assert all(context["started"] < task.args["when"] < ends for task in tasks)


@pytest.mark.parametrize("budget", [{"max_error": TARGET}, {"max_seconds": 6e5}])
def test_steps_that_tasks_would_share_are_made_by_one(store, budget):
    """Attempts have no rounds: a share of a step would be taken for the factors."""
    own = {"method": "cta", "n_clusters": 4, "max_iterations": 1, "step_tasks": 2}
    request = normal(budget, settings=LEFT_OPEN | {"compress": own}, effects=NO_BOUNCES)
    results = Results()
    for stage in REGISTRY.stages("asset", request, begun(store, request)):
        run_stage(stage, results, store)
        if stage.name == "quantise 1":
            break
    (made,) = results["compress 1"]
    assert "factors" in made.get("attempted", made)
    assert results["quantise 1"][0]["asset"]


def test_a_black_reference_is_refused_as_one(met):
    request, context, results, _ = met
    black = Results()
    stages = {stage.name: stage for stage in REGISTRY.stages("asset", request, context)}
    for name in list(stages)[: list(stages).index("measure 1")]:
        black.add(name, results[name], results.measured(name))
    cameras = copy.deepcopy(results["measure 1"])
    for view in (view for camera in cameras for view in camera["views"]):
        view["squared_norm"] = view["variance"] = 0.0
    black.add("measure 1", cameras, results.measured("measure 1"))
    with pytest.raises(SettingsError, match="no tuning view shows light") as raised:
        stages["compress 1"].tasks(black)
    assert raised.value.pointer == "/budget/max_error"


def until_held_out(results, names):
    """The results up to the first validation, whose views err by more than they did."""
    cameras = copy.deepcopy(results["validate 1"])
    views = [view for camera in cameras for view in camera["views"]]
    scale = 1.04 * TARGET / pooled_budget(views)["total"]
    for view in views:
        view["budget"]["total"] *= scale
    held = Results()
    for name in names[: names.index("validate 1") + 1]:
        values = cameras if name == "validate 1" else results[name]
        held.add(name, values, results.measured(name))
    return held


def test_a_mend_that_runs_late_is_refused_by_the_time(met):
    request, context, results, _ = met
    pressed = request | {"budget": request["budget"] | {"max_seconds": 6e5}}
    listed = REGISTRY.stages("asset", pressed, context)
    stages = {stage.name: stage for stage in listed}
    held = until_held_out(results, list(stages))
    mends = stages["compress 5"].tasks(held)
    assert len(mends) == 1
    held.add("compress 5", [leaving.LATE], results.measured("plan 1")[:1])
    with pytest.raises(SettingsError, match=r"held-out views err by 26\.00%") as raised:
        stages["quantise 5"].tasks(held)
    assert raised.value.pointer == "/budget/max_seconds"


def test_numbers_left_to_a_trial_keep_the_search_low_and_it_says_so(timed):
    """The results of a ladder that was not predicted: an open number has no plan of its own."""
    request, context, results, _ = timed
    first = Results()
    for name in list(results)[: list(results).index("clock 1") + 1]:
        values = results[name]
        if name == "plan 1":
            values = [values[0] | {"plan": values[0]["plan"] | {"ladder": []}}]
        first.add(name, values, results.measured(name))
    bake = LEFT_OPEN["bake"] | {"cube_resolution": "auto"}
    opened = request | {"settings": request["settings"] | {"bake": bake}}
    (only,) = search_of(opened, context).tried(first)
    assert only.taken
    assert "leaves cube_resolution of the bake to a trial" in only.why
    (pinned,) = search_of(request, context).tried(first)
    assert pinned.why == "nothing is above it"
