"""Bytes of an asset as a whole: alone, beside an error and beside a time, through the real stages."""

import copy
import json
from math import isclose

import pytest

from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.budget import search_of
from prtbake_workers.jobs.error_attempts import MENDED
from prtbake_workers.jobs.estimate import predict
from prtbake_workers.jobs.registry import REGISTRY
from prtbake_workers.jobs.search_stages import numbered
from prtbake_workers.planning.error_search import WINDOW
from support.budgeted import LEFT_OPEN, normal
from support.budgeted import begun as begun_at
from support.local_stages import run_stage, run_stages

TARGET = 0.08
FEW_LOBES = {"fit_light": {"n_lobes": 32, "max_iterations": 1}}


def begun(store, request):
    return begun_at(store, request, tessellation=3)


def made(store, budget, **changes):
    request = normal(budget, **changes)
    context = begun(store, request)
    results = run_stages(REGISTRY.stages("asset", request, context), store)
    return request, context, results, REGISTRY.finish("asset", request, context, results)


def asset_of(store, finished):
    return store.local_path({file.name: file.digest for file in finished.artefacts}["asset.h5"])


def report_of(store, finished):
    files = {file.name: file.digest for file in finished.artefacts}
    return json.loads(store.read_bytes(files["report.json"]))


MOST = 31_000


@pytest.fixture(scope="module")
def alone(store):
    return made(store, {"max_bytes": MOST}, quality="draft", settings=LEFT_OPEN | FEW_LOBES)


def test_bytes_alone_are_filled_at_the_quality_beside_them(alone, store):
    request, _, _, finished = alone
    size = asset_of(store, finished).stat().st_size
    assert 0.9 * MOST <= size <= MOST
    assert finished.result["bytes"]["asset.h5"] == size
    assert read_asset(asset_of(store, finished)).provenance["compress"]["max_bytes"] == MOST
    (only,) = finished.result["search"]["attempts"]
    assert (only["name"], only["bytes"], only["taken"]) == ("quality draft", size, True)
    report = report_of(store, finished)
    assert report["search"]["budget"] == request["budget"]
    assert f"asset.h5 takes {size} of {MOST} bytes" in " ".join(report["notes"])
    assert report["settings"]["compress"]["max_bytes"] == MOST
    # predictions stand beside it, as beside any quality, and none is of more bytes
    stages = {stage["name"]: stage["predicted_seconds"] for stage in report["stages"]}
    assert stages["bake"] > 0.0
    assert all(step["asset_bytes"] <= MOST for step in report["ladder"])
    assert {step["quality"] for step in report["ladder"]} == {None, "low"}


def test_the_light_and_the_exact_asset_are_files_of_their_own(alone, store):
    *_, finished = alone
    sizes = {file.name: store.size(file.digest) for file in finished.artefacts}
    assert sizes["asset.h5"] <= MOST < sizes["asset.h5"] + sizes["light.h5"]


def test_a_lone_quality_teaches_the_cost_model_and_a_search_does_not(alone):
    *_, finished = alone
    assert set(finished.rates.ratios) >= {"bake", "fit_light"}
    assert "compress" not in finished.rates.ratios


def test_bytes_that_tables_exceed_are_refused_with_the_least(alone):
    """The results of a job up to its asset, of a request for fewer bytes."""
    request, context, results, _ = alone
    few = {"refused": {"detail": "alone take 9", "pointer": "/settings/compress/max_bytes"}}
    refused = Results()
    listed = {stage.name: stage for stage in REGISTRY.stages("asset", request, context)}
    for name in list(listed)[: list(listed).index("quantise")]:
        refused.add(name, results[name], results.measured(name))
    refused.add("quantise", [few], results.measured("quantise"))
    with pytest.raises(SettingsError, match="alone take 9") as raised:
        listed["fit_light"].tasks(refused)
    assert raised.value.pointer == "/budget/max_bytes"


@pytest.mark.parametrize("budget", [{}, {"max_error": TARGET}, {"max_seconds": 6e5}])
def test_bytes_that_the_mesh_exceeds_are_refused_before_the_bake(store, budget):
    request = normal(budget | {"max_bytes": 900})
    context = begun(store, request)
    stage = next(s for s in REGISTRY.stages("asset", request, context) if s.name.startswith("plan"))
    with pytest.raises(SettingsError, match=r"the mesh alone takes more than \d{4,}") as raised:
        run_stage(stage, Results(), store)
    assert raised.value.pointer == "/budget/max_bytes"
    # so does the estimate
    with pytest.raises(SettingsError, match="the mesh alone"):
        predict(job_request_adapter.validate_python(request), request, context, store)


def test_bytes_between_the_mesh_and_its_tables_are_refused_by_the_file(store):
    with pytest.raises(SettingsError, match="mesh, tables and labels alone take") as raised:
        made(store, {"max_bytes": 20_000}, quality="draft")
    assert raised.value.pointer == "/budget/max_bytes"


@pytest.fixture(scope="module")
def ample(store):
    """An error, and more bytes than it takes."""
    return made(store, {"max_error": TARGET, "max_bytes": 10**6})


def test_an_error_that_takes_fewer_bytes_is_all_that_is_spent(ample, store):
    *_, finished = ample
    size = asset_of(store, finished).stat().st_size
    assert size < 10**5
    assert finished.result["budget"]["total"] <= TARGET
    taken = [one for one in finished.result["search"]["attempts"] if one["taken"]]
    assert taken[-1]["name"].startswith("compression, max_error")
    notes = report_of(store, finished)["notes"]
    assert f"asset.h5 takes {size} of 1000000 bytes" in notes


def retold(ample, store, most):
    """The same search with other bytes: what an error took is as it was, the rest is run."""
    request, context, results, _ = ample
    held = request | {"budget": request["budget"] | {"max_bytes": most}}
    stages, known = REGISTRY.stages("asset", held, context), Results()
    names = [stage.name for stage in stages]
    at = next(
        place
        for place in range(len(names))
        if names[place].startswith("measure asset") and not results[names[place]]
    )
    # a later trial may not have been made: what is listed says so
    for stage in stages[: at - 2]:
        known.add(stage.name, results[stage.name], results.measured(stage.name))
    for stage in stages[at - 2 :]:
        run_stage(stage, known, store)
    return held, context, known, REGISTRY.finish("asset", held, context, known)


def test_both_are_met_where_the_error_takes_a_little_too_much(ample, store):
    *_, finished = ample
    size = finished.result["bytes"]["asset.h5"]
    most = size - 200
    held, _, _, found = retold(ample, store, most)
    path = asset_of(store, found)
    assert 0.9 * most <= path.stat().st_size <= most
    assert found.result["budget"]["total"] <= TARGET
    search = found.result["search"]
    taken = [one for one in search["attempts"] if one["taken"]]
    assert taken[-1]["name"] == f"compression, max_bytes {most}"
    assert taken[-1]["error"] <= WINDOW[1] * search["aim"]
    assert taken[-1]["bytes"] == path.stat().st_size
    report = report_of(store, found)
    assert report["search"]["budget"] == held["budget"]
    assert report["settings"]["compress"]["max_bytes"] == most
    assert report["settings"]["compress"]["max_error"] is None
    assert all(step["asset_bytes"] <= most for step in report["ladder"])
    assert f"asset.h5 takes {path.stat().st_size} of {most} bytes" in " ".join(report["notes"])


def test_an_error_that_the_bytes_do_not_hold_is_refused_with_the_best_and_the_line(ample, store):
    with pytest.raises(SettingsError, match=r"in \d+ bytes cannot be met: at best") as raised:
        retold(ample, store, 27_000)
    assert raised.value.pointer == "/budget/max_bytes"
    assert "the largest part of it is compression" in str(raised.value)
    assert str(raised.value).endswith("bytes")


def test_a_mend_that_its_labels_leave_no_bytes_is_refused_by_the_budget(ample):
    """Held-out views err by more, and all bytes are made use of: these may be too few for that."""
    request, context, results, finished = ample
    most = finished.result["bytes"]["asset.h5"] + 200
    held = request | {"budget": request["budget"] | {"max_bytes": most}}
    stages, known = {s.name: s for s in REGISTRY.stages("asset", held, context)}, Results()
    mend, cut = (numbered(name, MENDED) for name in ("compress", "quantise"))
    for name in list(stages)[: list(stages).index(mend)]:
        values = copy.deepcopy(results[name])
        for camera in values if name == "validate 1" else ():
            for view in camera["views"]:
                view["budget"]["total"] = 1.02 * TARGET
        known.add(name, values, results.measured(name))
    tasks = stages[mend].tasks(known)
    assert tasks
    known.add(mend, results["compress 1"], results.measured("compress 1"))
    (task,) = stages[cut].tasks(known)
    assert task.function.endswith("shared_stages:attempt")
    few = {"refused": {"detail": "alone take 9", "pointer": "/settings/compress/max_bytes"}}
    known.add(cut, [few], results.measured("quantise 1"))
    with pytest.raises(SettingsError, match="held-out views err by") as raised:
        stages["validate 2"].tasks(known)
    assert raised.value.pointer == "/budget/max_bytes"


HELD = 31_500
"""Bytes that the lowest step keeps to by itself, and others do not."""


@pytest.fixture(scope="module")
def timed(store):
    return made(store, {"max_seconds": 200.0, "max_bytes": HELD}, settings=LEFT_OPEN | FEW_LOBES)


def test_every_attempt_in_time_keeps_to_the_bytes(timed, store):
    *_, results, finished = timed
    first, *others = finished.result["search"]["attempts"]
    assert others
    assert first["bytes"] <= HELD
    assert all(0.9 * HELD <= one["bytes"] <= HELD for one in others)
    size = asset_of(store, finished).stat().st_size
    assert size == others[-1]["bytes"]
    report = report_of(store, finished)
    assert f"asset.h5 takes {size} of {HELD} bytes" in " ".join(report["notes"])
    assert all(step["asset_bytes"] <= HELD for step in report["ladder"])
    assert finished.result["metrics"]
    # the first is its quality's file, and what is delivered is cut
    cut = "object left out for its bytes"
    assert cut not in results["quantise 1"][0]["attempted"]["errors"]
    assert finished.result["errors"]["quantise"][cut] > 0.0


def test_bytes_change_no_fit_of_a_step_that_keeps_to_them(timed):
    """Seconds are predicted by its sizes."""
    request, context, results, _ = timed
    before = Results()
    for name in list(results)[: list(results).index("compress 1")]:
        before.add(name, results[name], results.measured(name))

    def fits(most):
        budget = request["budget"] | {"max_bytes": most}
        stages = REGISTRY.stages("asset", request | {"budget": budget}, context)
        (own,) = (stage for stage in stages if stage.name == "compress 1")
        return [task.key for task in own.tasks(before)]

    assert fits(HELD) == fits(None) == fits(10**12)


def test_a_step_whose_tables_do_not_fit_leaves_the_one_before(timed, store):
    request, context, results, _ = timed
    few = {"refused": {"detail": "alone take 9", "pointer": "/settings/compress/max_bytes"}}
    known, left = Results(), list(REGISTRY.stages("asset", request, context))
    while left[0].name != "quantise 2":
        name = left.pop(0).name
        known.add(name, results[name], results.measured(name))
    known.add("quantise 2", [few], results.measured("quantise 2"))
    before, last = search_of(request, context).tried(known)
    assert (before.taken, before.why) == (True, "the best that fits into the bytes")
    assert (last.taken, last.why) == (False, "alone take 9")
    for stage in left[1:]:
        run_stage(stage, known, store)
    finished = REGISTRY.finish("asset", request, context, known)
    digest = {file.name: file.digest for file in finished.artefacts}["asset.h5"]
    assert digest == results["quantise 1"][0]["attempted"]["asset"]
    # the lowest step has none before it
    first = Results()
    for name in list(results)[: list(results).index("quantise 1")]:
        first.add(name, results[name], results.measured(name))
    first.add("quantise 1", [few], results.measured("quantise 1"))
    with pytest.raises(SettingsError, match="alone take 9") as raised:
        search_of(request, context).tried(first)
    assert raised.value.pointer == "/budget/max_bytes"


def test_an_estimate_holds_the_asset_to_its_bytes(store):
    plain = normal(None, quality="draft")
    free = predict(job_request_adapter.validate_python(plain), plain, begun(store, plain), store)
    for budget in ({}, {"max_error": 0.05}, {"max_seconds": 6e5}):
        most = free.artefact_bytes["asset.h5"] // 2
        request = normal(budget | {"max_bytes": most})
        found = predict(
            job_request_adapter.validate_python(request), request, begun(store, request), store
        )
        assert found.artefact_bytes["asset.h5"] == most
        assert any("searched from quality draft on" in one for one in found.warnings) == bool(
            budget
        )
    # bytes that an error has no use for are no prediction
    wide = normal({"max_error": 0.05, "max_bytes": 10**9})
    found = predict(job_request_adapter.validate_python(wide), wide, begun(store, wide), store)
    assert isclose(found.artefact_bytes["asset.h5"], free.artefact_bytes["asset.h5"])
