"""Lone bakes with a budget through the real stages, in this process."""

import copy
import re
import time
from dataclasses import replace
from math import inf, sqrt

import pytest

from prtbake_storage.contract.bake_budget import MOST_CENTRES_TRIED, BakeBudget
from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.stages import Measured, Results
from prtbake_workers.jobs import bake_trial, leaving, plan
from prtbake_workers.jobs.bake_lines import account_of, lines_of
from prtbake_workers.jobs.budget import search_of
from prtbake_workers.jobs.estimate import predict
from prtbake_workers.jobs.plan import arguments, plan_scene
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.search_stages import BAKE
from prtbake_workers.jobs.work import wall_seconds
from prtbake_workers.planning.bake_model import BakeModel, sized
from prtbake_workers.planning.bake_search import WINDOW
from prtbake_workers.planning.later_stages import REPORT_WORK
from prtbake_workers.planning.light_resolution import CENTRES
from prtbake_workers.planning.presets import StageSettings
from prtbake_workers.planning.time_search import MARGIN
from support.local_stages import registered, run_stage, run_stages
from support.scenes import GLOSSY, NO_RESOURCE

TARGET = 0.2
NO_BOUNCES = {"interreflection": "off"}


def normal(budget, **changes):
    """A request as the service stores it."""
    request = {
        "kind": "bake",
        "mesh": f"mesh-{NO_RESOURCE}",
        "brdf": {"model": "lambert", "albedo": 0.7},
        "receiver": {"resolution": 8},
        "budget": budget,
        **changes,
    }
    return job_request_adapter.validate_python(request).model_dump(mode="json")


def begun(store, request, name="icosphere", tessellation=2):
    """What the service and the engine tell of a job that starts now."""
    return {
        "mesh": registered(store, "mesh", builtin={"name": name, "tessellation": tessellation}),
        "brdf": {"spec": request["brdf"]},
        "materials": {},
        "artefacts": {},
        "started": time.time(),
    }


def run(store, request, context):
    return run_stages(REGISTRY.stages("bake", request, context), store)


def finished(store, request, context):
    results = run(store, request, context)
    return results, REGISTRY.finish("bake", request, context, results)


def figure_of(errors, lines):
    """The error that is promised, from the errors that every report lists."""
    return max(
        sqrt(
            lines[name]["effects left out"]
            + errors["plan"][name]
            + errors["bake"][f"{name} in other directions"]
            + errors["bake"][f"{name} 16-bit"]
            + sum(
                errors.get("bounces", {}).get(f"{name} {line}", 0.0)
                for line in ("rays", "left out", "16-bit", "scattering")
            )
        )
        for name in lines
    )


@pytest.fixture(scope="module")
def met(store):
    request = normal({"max_error": TARGET}, effects=NO_BOUNCES)
    context = begun(store, request)
    return request, context, *finished(store, request, context)


def test_an_error_is_reached_within_a_tenth_and_not_exceeded(met):
    *_, done = met
    search = done.result["search"]
    assert WINDOW * TARGET <= search["error"] <= TARGET
    (taken,) = (one for one in search["attempts"] if one["taken"])
    assert taken["error"] == search["error"]
    assert taken["bytes"] == done.result["bytes"]["transfer.h5"]
    assert all(one["why"] and one["seconds"] > 0.0 for one in search["attempts"])


def test_it_is_the_root_of_the_sum_of_the_errors_that_the_report_lists(met):
    *_, done = met
    search = done.result["search"]
    assert set(search["lines"]) == {"object", "receiver"}
    assert search["error"] == pytest.approx(figure_of(done.result["errors"], search["lines"]))
    part, line = search["part"], search["binds"]
    assert search["lines"][part][line] == max(search["lines"][part].values())


def test_what_is_delivered_is_the_bake_that_was_taken(met, store):
    *_, done = met
    files = {file.name: file.digest for file in done.artefacts}
    assert set(files) == {"transfer.h5", "report.json", "report.html"}
    with open_transfer(store.local_path(files["transfer.h5"])) as transfer:
        own = transfer.header.provenance["bake"]
    (taken,) = (one for one in done.result["search"]["attempts"] if one["taken"])
    assert taken["name"].startswith(
        f"{own['n_centres']} centres, 6 x {own['cube_resolution']}^2 directions"
    )
    page = store.read_bytes(files["report.html"]).decode()
    assert "What was tried for the budget" in page
    assert "account of its transfer" in page
    assert "tuning views" not in page


def test_fewer_directions_would_leave_more_than_was_asked_for(met, store):
    """The negative twin: a bake of the same centres by a coarser cube map."""
    _, context, results, _ = met
    bakes = [results[name][0] for name in results if name.startswith("plan ") and results[name]]
    own = bakes[-1]["settings"]["bake"]
    coarser = {"n_centres": own["n_centres"], "cube_resolution": own["cube_resolution"] // 2}
    plain = normal(None, settings=coarser, effects=NO_BOUNCES)
    lines = lines_of(run(store, plain, context))
    assert max(sqrt(sum(one.values())) for one in lines.values()) > TARGET


def test_terms_and_bounces_share_an_error(store):
    request = normal({"max_error": 0.3}, brdf=GLOSSY, receiver={"resolution": 8, "albedo": 0.6})
    context = begun(store, request, "teapot", 3)
    results, done = finished(store, request, context)
    search = done.result["search"]
    assert WINDOW * 0.3 <= search["error"] <= 0.3
    assert search["error"] == pytest.approx(figure_of(done.result["errors"], search["lines"]))
    assert 0.0 < search["lines"]["object"]["terms"] < 0.09
    bounced = [one["rays of bounces"] for one in search["lines"].values()]
    assert 0.0 < max(bounced) < 0.3 * 0.09
    # the twin that nothing bounds is no bake that keeps an error
    seen, endless = search_of(request, context).delivered(results), Results()
    for name in seen:
        values = copy.deepcopy(seen[name])
        for block in values if name == "bounces" else ():
            block["left_out"] = None
        endless.add(name, values, seen.measured(name))
    lines = lines_of(endless)
    assert lines["object"]["later bounces"] == inf
    assert account_of(lines)["error"] is None
    assert account_of(lines)["binds"] == "later bounces"


def test_a_black_receiver_shows_no_error_and_decides_nothing(store):
    """It catches shadows that nothing shows; its transfer is baked all the same, and errs."""
    black = {"resolution": 8, "albedo": 0.0}
    request = normal({"max_error": 0.12}, receiver=black, effects=NO_BOUNCES)
    results, done = finished(store, request, begun(store, request))
    search = done.result["search"]
    assert search["part"] == "object"
    assert search["error"] <= 0.12
    assert not any(search["lines"]["receiver"].values())
    stored = done.result["errors"]["bake"]["receiver in other directions"]
    assert stored > 1e-3
    # the twin: the same numbers of a grey one, which shows what its transfer errs by
    plan = search_of(request, begun(store, request)).delivered(results)
    plan["plan"][0]["black"] = [False, False]
    assert lines_of(plan)["receiver"]["directions and functions"] == stored


def test_terms_that_no_number_of_them_mends_are_refused_and_named(store):
    sharp = {"model": "ggx", "alpha": 0.1}
    request = normal({"max_error": 0.1}, brdf=sharp, receiver=None)
    with pytest.raises(SettingsError, match=r"\d+ terms, .* leave 4\d\.\d\d%") as raised:
        run(store, request, begun(store, request))
    assert raised.value.pointer == "/budget/max_error"


def test_a_lobe_that_few_terms_hold_little_of_gets_the_most_that_are_chosen(store, monkeypatch):
    """Where half of its energy takes more terms, their number is what the bake is asked for."""
    monkeypatch.setattr(bake_trial, "MOST_TERMS", 20)
    sharp = {"model": "ggx", "alpha": 0.1}
    given = {"n_centres": 12, "cube_resolution": 8}
    request = normal({"max_bytes": 10**8}, brdf=sharp, receiver=None, settings=given)
    context = begun(store, request, "icosphere", 1)
    results, done = finished(store, request, context)
    (option,) = results["trial"][0]["options"]
    assert (option["n_terms"], option["term_energy_lost"]) == (20, None)
    own = results["plan 1"][0]
    assert own["settings"]["bake"]["n_terms"] == 20
    # a pair that belongs together is not split
    assert own["plan"]["parts"][0]["n_terms"] in (19, 20)
    (attempt,) = done.result["search"]["attempts"]
    assert attempt["name"].endswith(", 20 terms")
    size = sized(results["trial"][0], 12, option["terms"])
    assert attempt["bytes"] == pytest.approx(size, rel=0.1)


def test_an_error_out_of_reach_is_refused_with_the_best_and_the_line(store):
    given = {"n_centres": 42, "cube_resolution": 12}
    request = normal({"max_error": 0.02}, settings=given, effects=NO_BOUNCES)
    context = begun(store, request)
    with pytest.raises(
        SettingsError, match=r"2\.00% cannot be met: at best (\d+\.\d+)% is predicted"
    ) as raised:
        run(store, request, context)
    assert raised.value.pointer == "/budget/max_error"
    assert "directions and functions leave" in str(raised.value)
    # the estimate says so before
    with pytest.raises(SettingsError, match="cannot be met"):
        predict(job_request_adapter.validate_python(request), request, context, store)
    # and the best that it names can be had
    best = float(str(raised.value).split("at best ")[1].split("%")[0]) / 100.0
    easier = normal({"max_error": 1.2 * best}, settings=given, effects=NO_BOUNCES)
    _, done = finished(store, easier, context)
    assert done.result["search"]["error"] <= 1.2 * best
    assert done.result["search"]["attempts"][0]["name"] == "42 centres, 6 x 12^2 directions"


def test_bytes_are_kept_and_no_more_centres_would_fit(store):
    fine = {"cube_resolution": 12}
    plain = normal(None, settings=fine | {"n_centres": 162}, effects=NO_BOUNCES)
    context = begun(store, plain)
    size = run(store, plain, context)["join"][0]["bytes"]
    for share, centres in ((0.9, 42), (1.1, 162)):
        asked = int(share * size)
        _, done = finished(
            store, normal({"max_bytes": asked}, settings=fine, effects=NO_BOUNCES), context
        )
        assert done.result["bytes"]["transfer.h5"] <= asked
        (taken,) = (one for one in done.result["search"]["attempts"] if one["taken"])
        assert taken["name"] == f"{centres} centres, 6 x 12^2 directions"


def test_a_trial_foretells_the_bytes_of_a_plan_with_other_numbers(store):
    """Tables of few vertices weigh as much as what is baked: at K = 1, 40 and 126."""
    request = normal({"max_bytes": 10**9}, brdf=GLOSSY, receiver=None)
    context = begun(store, request, "icosphere", 1)
    budget = BakeBudget(max_bytes=10**9)
    few = request | {"settings": {"cube_resolution": 5}}
    trial = bake_trial.tried(bake_trial.task(few, context, budget).args, store)
    for terms, centres in ((1, 12), (40, 42), (126, 42)):
        bake = BakeSettings(n_terms=terms, n_centres=centres, cube_resolution=24)
        args = arguments(request, context, StageSettings.for_bake(bake), "medium")
        planned, plan = plan_scene(args, store)
        (made,) = (own.n_terms for own in planned.factorisations)
        known = plan.artefact_bytes["transfer.h5"]
        # a table of one term packs less well than that of sixteen, by a quarter of 3 kB
        assert sized(trial, centres, [made]) == pytest.approx(known, rel=0.03)
        # and the twin, whose tables are those of the trial
        frozen = trial | {
            "parts": [part | {"term_bytes": 0.0} for part in trial["parts"]],
            "fixed_bytes": trial["fixed_bytes"] + 16 * trial["parts"][0]["term_bytes"],
        }
        assert sized(frozen, centres, [made]) != pytest.approx(known, rel=0.1)


def test_bytes_that_no_bake_fits_into_are_refused_with_the_least(store):
    request = normal({"max_bytes": 2000}, effects=NO_BOUNCES)
    with pytest.raises(SettingsError, match=r"least that can be asked for .* be \d+") as raised:
        run(store, request, begun(store, request))
    assert raised.value.pointer == "/budget/max_bytes"


def test_a_second_is_too_short_and_the_error_tells_the_least(store):
    for more in ({}, {"max_error": 0.3}):
        given = {"n_centres": 42}
        request = normal({"max_seconds": 1.0} | more, settings=given, effects=NO_BOUNCES)
        context = begun(store, request)
        with pytest.raises(SettingsError, match=r"1 s are too few: ") as raised:
            run(store, request, context)
        assert raised.value.pointer == "/budget/max_seconds"
        # the job may be late before it knows; the estimate takes its time
        parsed = job_request_adapter.validate_python(request)
        with pytest.raises(SettingsError, match=r"1 s are too few: .* predicted to .*\d+ s"):
            predict(parsed, request, context, store)


def tried(store, budget, settings, **changes):
    """What a trial finds that nothing stops, however slow this machine is."""
    request = normal(budget, settings=settings, effects=NO_BOUNCES, **changes)
    limits = BakeBudget.model_validate(budget)
    return bake_trial.tried(bake_trial.task(request, begun(store, request), limits).args, store)


def test_bytes_that_cut_a_trial_short_are_refused_and_not_the_error(store):
    """They hold 12 centres alone, which leave too much; those that are named let 42 be tried."""
    fine, error = {"cube_resolution": 12}, {"max_error": 0.05}
    few = tried(store, error | {"max_bytes": 1}, fine)
    size = sized(few, 12, few["options"][0]["terms"])
    budget = error | {"max_bytes": round(1.05 * size)}
    request = normal(budget, settings=fine, effects=NO_BOUNCES)
    words = r"; 42 centres are tried where there are (\d+) bytes at least"
    with pytest.raises(SettingsError, match=words) as raised:
        run(store, request, begun(store, request))
    assert raised.value.pointer == "/budget/max_bytes"
    named = int(re.search(words, str(raised.value))[1])
    assert named > budget["max_bytes"]
    more = tried(store, error | {"max_bytes": named}, fine)
    assert {one["n_centres"] for one in more["candidates"]} == {12, 42}
    # the twin, that no bytes cut
    assert tried(store, error, fine)["cut"] is None


def test_the_most_centres_beside_a_budget_are_the_most_that_are_tried():
    """The contract refuses more without knowing the trial."""
    assert CENTRES[-1] == MOST_CENTRES_TRIED


@pytest.mark.parametrize("budget", [None, {"max_error": 0.3}])
def test_what_a_bake_refuses_is_pointed_at_among_its_own_settings(store, budget):
    """Those of an asset lie a stage deeper."""
    request = normal(budget, settings={"n_centres": 42, "bandwidth": 5e4})
    with pytest.raises(SettingsError, match="bandwidth 50000 is too large") as raised:
        run(store, request, begun(store, request))
    assert raised.value.pointer == "/settings/bandwidth"


def test_what_takes_long_to_try_is_not_tried_for_a_short_time(store):
    """All counts together take no more than a share of the time, and the fewest have to fit."""
    most, cut = {}, {}
    for seconds in (8.0, 20.0, None):
        budget = {"max_bytes": 10**9} if seconds is None else {"max_seconds": seconds}
        found = tried(store, budget, {"cube_resolution": 18})
        most[seconds] = max(one["n_centres"] for one in found["candidates"])
        cut[seconds] = found["cut"]
    assert most[8.0] < most[20.0] <= most[None] == 642
    next_tried = 4 * most[8.0] - 6
    assert (cut[8.0]["field"], cut[8.0]["n_centres"]) == ("max_seconds", next_tried)
    assert cut[8.0]["least"] > 8.0
    assert cut[None] is None
    # the fewest are as many as the request gives
    with pytest.raises(SettingsError, match="5 s are too few: trying 2562 centres") as raised:
        tried(store, {"max_seconds": 5.0}, {"n_centres": 2562}, receiver=None)
    assert raised.value.pointer == "/budget/max_seconds"


def test_a_trial_that_is_late_is_refused_by_the_time(store):
    request = normal({"max_seconds": 60.0}, effects=NO_BOUNCES)
    context = begun(store, request)
    stages = search_of(request, context).stages()
    (task,) = stages[0].tasks(Results())
    assert context["started"] < task.args["when"] < context["started"] + 60.0
    late = Results()
    late.add("trial", [leaving.LATE], [Measured(60.0, 1)])
    with pytest.raises(SettingsError, match="60 s are too few: they were out before") as raised:
        stages[2].tasks(late)
    assert raised.value.pointer == "/budget/max_seconds"


SECONDS = 24.0


def timed_run(store, elapsed):
    """Run a job whose looks at the clock tell what is given, however slow this machine is."""
    given = {"n_centres": 42}
    request = normal({"max_seconds": SECONDS}, settings=given, effects=NO_BOUNCES)
    context = begun(store, request)
    # no task leaves by the real clock
    context["started"] += 1e5
    results = Results()
    for stage in REGISTRY.stages("bake", request, context):
        if stage.name not in elapsed:
            run_stage(stage, results, store)
        elif stage.tasks(results):
            results.add(stage.name, [{"elapsed": elapsed[stage.name]}], [Measured(0.0, 1)])
        else:
            results.add(stage.name, [], [])
    return request, context, results, REGISTRY.finish("bake", request, context, results)


@pytest.fixture(scope="module")
def timed(store):
    """So short that no bake takes a fifth of it: the quickest comes first, then a better one."""
    elapsed = {"clock": 2.0, "clock 1": 8.0, "clock 2": 16.0, "clock 3": 21.0, "clock 4": 23.0}
    return timed_run(store, elapsed)


def test_bakes_get_better_while_there_is_time(timed):
    *_, done = timed
    attempts = done.result["search"]["attempts"]
    errors = [one["error"] for one in attempts]
    assert len(errors) > 1
    assert errors == sorted(errors, reverse=True)
    assert [one["taken"] for one in attempts] == [False] * (len(attempts) - 1) + [True]


def test_a_first_bake_that_took_most_of_the_time_is_the_last(timed, store):
    """The twin of the same scene: by what that took no better one ends in time."""
    *_, done = timed_run(store, {"clock": 2.0, "clock 1": 16.0, "clock 2": 23.0})
    (only,) = done.result["search"]["attempts"]
    assert only["taken"]
    assert only["error"] == timed[-1].result["search"]["attempts"][0]["error"]


def test_a_bake_that_is_late_leaves_the_one_before(timed, store):
    request, context, results, *_ = timed
    stages = {stage.name: stage for stage in REGISTRY.stages("bake", request, context)}
    late = Results()
    for name in list(stages)[: list(stages).index("bake 2")]:
        late.add(name, results[name], results.measured(name))
    late.add("bake 2", [leaving.LATE], results.measured("bake 1")[:1])
    for name in list(stages)[list(stages).index("bake 2") + 1 :]:
        run_stage(stages[name], late, store)
    done = REGISTRY.finish("bake", request, context, late)
    first, second = done.result["search"]["attempts"]
    assert (first["taken"], second["taken"]) == (True, False)
    assert "time was out" in second["why"]
    assert done.result["search"]["error"] == first["error"]
    # what nothing bounds is told as that, and small errors with their figures
    search, none = search_of(request, context), (0.0, 0.0)
    made = replace(search.trail(late).told[0], projection=none, terms=none)
    for squared, words in ((inf, "leaves what nothing bounds in"), (1e-10, "leaves 0.001% in")):
        assert words in search.too_late([replace(made, rest=(squared, 0.0))])
    # and where it was the first, there is nothing to deliver
    late = Results()
    for name in list(stages)[: list(stages).index("bake 1")]:
        late.add(name, results[name], results.measured(name))
    late.add("bake 1", [leaving.LATE], results.measured("plan 1"))
    with pytest.raises(SettingsError, match="s were out before a bake") as raised:
        stages["scattering 1"].tasks(late)
    assert raised.value.pointer == "/budget/max_seconds"


def test_tasks_of_a_timed_bake_leave_in_time(timed):
    request, context, results, *_ = timed
    stages = {stage.name: stage for stage in REGISTRY.stages("bake", request, context)}
    planned = Results()
    for name in list(stages)[: list(stages).index("bake 1")]:
        planned.add(name, results[name], results.measured(name))
    tasks = stages["bake 1"].tasks(planned)
    assert tasks
    ends = context["started"] + SECONDS
    report = wall_seconds({"report": REPORT_WORK}, context, ["report"])
    assert max(task.args["when"] for task in tasks) == pytest.approx(ends - MARGIN * report)
    assert all(context["started"] < task.args["when"] for task in tasks)


def test_a_slow_bake_keeps_more_for_the_report(timed):
    """What it took over its prediction is what the report may take over its own."""
    request, context, results, *_ = timed
    search = search_of(request, context)
    model = BakeModel(results["trial"][0], lambda work: wall_seconds(work, context, BAKE))
    first = search.trail(results).told[0]
    predicted = model.foreseen(None, 0.0).seconds[model.row(first.numbers)]

    def kept(off):
        return search.rest_seconds(model, [replace(first, seconds=off * predicted)])

    assert kept(3.0) == pytest.approx(3.0 * search.rest_seconds(model, []))
    assert kept(0.5) == kept(1.0) == search.rest_seconds(model, [])


def test_the_estimate_is_of_the_first_bake(met, store):
    request, context, results, _ = met
    found = predict(job_request_adapter.validate_python(request), request, context, store)
    first = results["join 1"][0]["bytes"]
    assert found.artefact_bytes["transfer.h5"] == pytest.approx(first, rel=0.1)
    words = found.warnings[0]
    assert "the first bake for the budget" in words
    told = float(words.split("leave ")[1].split("%")[0]) / 100.0
    assert told == pytest.approx(TARGET, rel=0.1)
    assert found.errors["directions and functions (object)"] > 0.0


def test_no_compression_is_tried_for_a_bake_that_nothing_compresses(store, monkeypatch):
    def compressing(*_, **__):
        raise AssertionError("a compression is tried")

    monkeypatch.setattr(plan, "try_parts", compressing)
    request = normal(None, settings={"cube_resolution": 8, "n_centres": 42}, effects=NO_BOUNCES)
    context = begun(store, request)
    results = Results()
    run_stage(REGISTRY.stages("bake", request, context)[0], results, store)
    assert results["plan"][0]["plan"]["artefact_bytes"]["transfer.h5"] > 0
    # an asset of the same bake tries one
    asset = request | {"kind": "asset", "environment": f"environment-{NO_RESOURCE}"}
    asset["settings"] = {"bake": request["settings"]}
    args = plan.arguments(asset, context, StageSettings.for_bake(BakeSettings()), "draft")
    with pytest.raises(AssertionError, match="a compression is tried"):
        plan.plan_scene(args, store)


def test_settings_stand_above_a_quality_in_a_bake_that_runs(store):
    settings = {"cube_resolution": 8, "n_centres": 42}
    request = normal(None, quality="draft", settings=settings, effects=NO_BOUNCES)
    results = run(store, request, begun(store, request))
    assert results["plan"][0]["settings"]["bake"]["n_centres"] == 42
    assert results["plan"][0]["settings"]["bake"]["term_energy_lost"] == 0.05
