"""Studies through the real stages, in this process: what is shared, what each point costs."""

import csv
import io
import json
import re

import numpy as np
import pytest

from prtbake_storage.contract.jobs import job_request_adapter
from prtbake_storage.decode.reconstruct import reconstruct
from prtbake_storage.errors import SettingsError
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.transfer import open_transfer
from prtbake_storage.queue.stages import Measured, Results, Rounds, Stage, Task
from prtbake_workers.jobs import study_estimate
from prtbake_workers.jobs.estimate import predict
from prtbake_workers.jobs.registry import KINDS, REGISTRY
from prtbake_workers.jobs.shared_stages import SharedStages, merged
from prtbake_workers.jobs.study import Study
from support.local_stages import run_stages
from support.scenes import asset_request, ball_context, run_until

CLUSTERS, RANKS = [2, 4, 8], [[2, 8, 4], [4, 16, 8]]
AXES = {"settings.n_clusters": CLUSTERS, "settings.ranks": RANKS}


@pytest.fixture(scope="module")
def ball(store):
    """A small glossy ball: request and context of an asset job, its results up to the join."""
    request = asset_request(
        receiver=None,
        settings={
            "bake": {"n_centres": 42},
            "render": {"width": 16, "height": 16},
            "validation": {
                "width": 24,
                "height": 18,
                "passes": 2,
                "samples": 8,
                "cameras": [{"name": "front"}],
            },
        },
    )
    context = ball_context(store, request)
    return request, context, run_until(store, request, context, "join")


def normal(request):
    """A request as the service stores it."""
    return job_request_adapter.validate_python(request).model_dump(mode="json")


def study_of(base, axes, own, **fields):
    request = normal({"kind": "study", "base": base, "axes": axes, **fields})
    n_points = len(job_request_adapter.validate_python(request).points())
    return request, {"contexts": [own], "points": [{"context": 0}] * n_points}


@pytest.fixture(scope="module")
def compression(ball):
    """Base request and context of a compression of the ball's transfer."""
    *_, results = ball
    base = {"kind": "compress", "transfer": "j/transfer.h5", "settings": {"max_iterations": 2}}
    digest = results["join"][0]["transfer"]
    return base, {"artefacts": {"transfer": {"digest": digest}}}


@pytest.fixture(scope="module")
def compressed(store, compression):
    base, own = compression
    request, context = study_of(base, AXES, own, label="clusters and ranks")
    return request, context, run_stages(REGISTRY.stages("study", request, context), store)


def file_of(compressed, store, name):
    request, context, results = compressed
    files = {f.name: f for f in REGISTRY.finish("study", request, context, results).artefacts}
    return store.read_bytes(files[name].digest)


@pytest.fixture(scope="module")
def table(compressed, store):
    return json.loads(file_of(compressed, store, "study.json"))


def dense(path, asset):
    """Stored and decoded transfer, whole, as float64, times the root of the area."""
    delivered = read_asset(asset)
    stored, decoded = [], []
    with open_transfer(path) as transfer:
        for index, (part, own) in enumerate(
            zip(transfer.header.parts, delivered.parts, strict=True)
        ):
            root = np.sqrt(part.areas)[:, None]
            n = part.n_vertices
            stored.append(root * transfer.read(index, 0, n).astype(np.float64).reshape(n, -1))
            decoded.append(root * reconstruct(own, slice(0, n)).astype(np.float64).reshape(n, -1))
    return stored, decoded


def test_every_promised_file_is_left(compressed, store):
    request, context, results = compressed
    finished = REGISTRY.finish("study", request, context, results)
    assert {file.name for file in finished.artefacts} == {
        "study.json", "study.csv", "frontier.png", "study.html", "report.json", "report.html",
    }  # fmt: skip
    assert all(store.size(file.digest) > 100 for file in finished.artefacts)
    assert finished.result["points"] == 6
    assert finished.result["seconds"]["total"] > 0
    assert finished.result["frontier"]
    assert file_of(compressed, store, "frontier.png").startswith(b"\x89PNG")


def test_the_error_is_that_of_the_delivered_file_against_the_transfer(compressed, table, store):
    request, context, results = compressed
    shares = Study(request, context, KINDS).shared.shares(results)
    path = store.local_path(context["contexts"][0]["artefacts"]["transfer"]["digest"])
    found = [point["error"] for point in table["points"]]
    for share, error in zip(shares, found, strict=True):
        stored, decoded = dense(path, store.local_path(share.results["quantise"][0]["asset"]))
        left = sum(((a - b) ** 2).sum() for a, b in zip(stored, decoded, strict=True))
        expected = left / sum((a**2).sum() for a in stored)
        # float32 differences against float64 ones; 2e-7 was seen
        assert error == pytest.approx(expected, rel=1e-5)
    # more of either makes it smaller, and by far more than that tolerance
    by_place = np.array(found).reshape(len(CLUSTERS), len(RANKS))
    assert (np.diff(by_place, axis=0) < 0).all()
    assert (np.diff(by_place, axis=1) < 0).all()
    assert by_place[0, 0] / by_place[-1, -1] > 2


def test_a_point_is_what_its_request_gives_alone(compressed, table, compression, store):
    request, context, results = compressed
    shares = Study(request, context, KINDS).shared.shares(results)
    point = table["points"][3]
    alone = normal(point["request"])
    assert alone["settings"]["n_clusters"] == CLUSTERS[1]
    assert alone["settings"]["ranks"] == RANKS[1]
    _, own = compression
    done = run_stages(REGISTRY.stages("compress", alone, own), store)
    assert shares[3].results["quantise"] == done["quantise"]
    assert point["bytes"] == store.size(done["quantise"][0]["asset"])
    assert point["errors"]["compress"] == done["compress"][0]["errors"]
    # negative twin: it is not any point's
    assert shares[2].results["quantise"] != done["quantise"]


def test_the_frontiers_are_what_comparing_all_with_all_finds(table):
    for cost in ("seconds", "bytes"):
        best = [
            one["point"]
            for one in table["points"]
            if not any(
                o[cost] <= one[cost] and o["error"] <= one["error"] and o != one
                for o in table["points"]
            )
        ]
        assert sorted(table["frontier"][cost]) == best
    # the fewest bytes and the least error always stand there
    for first, then in (("bytes", "error"), ("error", "bytes")):
        extreme = min(table["points"], key=lambda point: (point[first], point[then]))
        assert extreme["point"] in table["frontier"]["bytes"]


def test_the_csv_holds_the_same(compressed, table, store):
    text = file_of(compressed, store, "study.csv").decode()
    rows = list(csv.DictReader(io.StringIO(text)))
    assert len(rows) == len(table["points"])
    for row, point in zip(rows, table["points"], strict=True):
        assert float(row["error"]) == point["error"]
        assert float(row["seconds"]) == point["seconds"]
        assert int(row["bytes"]) == point["bytes"]
        assert json.loads(row["settings.ranks"]) == point["values"]["settings.ranks"]
        assert int(row["bytes_frontier"]) == ("bytes" in point["frontier"])
        assert float(row["seconds_compress"]) == point["stages"]["compress"]["seconds"]


def test_points_of_an_asset_share_the_bake(ball, store):
    """Two compressions of one scene: baked once, and the bake's seconds count in both."""
    body, own, results = ball
    base = body | {"kind": "asset"}
    request, context = study_of(base, {"settings.compress.n_clusters": [2, 6]}, own)
    done = run_stages(REGISTRY.stages("study", request, context), store)
    assert len(done["bake"]) == len(results["bake"])
    assert [len(done[name]) for name in ("plan", "join", "compress", "fit_light")] == [2, 1, 2, 1]
    points = json.loads(store.read_bytes(done["report"][0]["files"]["study.json"]))["points"]
    for point in points:
        stages = point["stages"]
        assert stages["bake"]["shared_seconds"] == stages["bake"]["seconds"] > 0
        assert stages["compress"]["shared_seconds"] == 0
        making = [s["seconds"] for name, s in stages.items() if name not in ("render", "validate")]
        assert point["seconds"] == pytest.approx(sum(making))
        assert point["check_seconds"] > 0
        assert point["error"] > 0
        assert point["noise"] is not None
        # the total is no more than its lines together
        assert point["error"] <= 1.001 * sum(point["lines"].values())
    assert points[0]["error"] != points[1]["error"]
    # of all that decides the lines the clusters alone differ, threefold
    few, many = (point["resolution"] for point in points)
    assert many["vectors"] == 3 * few["vectors"]
    assert few | {"vectors": 0} == many | {"vectors": 0}
    assert few["functions"] == 42
    # negative twin: another number of directions is another bake
    other, context = study_of(base, {"settings.bake.cube_resolution": [12, 8]}, own)
    planned, tiles, *_ = REGISTRY.stages("study", other, context)
    assert len(tiles.tasks(run_stages([planned], store))) == 2 * len(results["bake"])


def test_bakes_and_lights_can_be_studied(ball, store):
    body, own, _ = ball
    scene = {name: body[name] for name in ("mesh", "brdf")}
    bake = scene | {"kind": "bake", "settings": {"cube_resolution": 12}}
    light = {
        "kind": "fit_light",
        "environment": body["environment"],
        "settings": {"max_iterations": 1},
    }
    for base, axes in (
        (bake, {"settings.n_centres": [12, 42]}),
        (light, {"settings.n_lobes": [4, 24]}),
    ):
        request, context = study_of(base, axes, own)
        done = run_stages(REGISTRY.stages("study", request, context), store)
        points = json.loads(store.read_bytes(done["report"][0]["files"]["study.json"]))["points"]
        assert points[0]["error"] > 1.1 * points[1]["error"] > 0
        assert points[0]["bytes"] < points[1]["bytes"]


def test_an_error_that_no_lobes_meet_is_left_out(ball, store):
    body, own, _ = ball
    base = {
        "kind": "fit_light", "environment": body["environment"],
        "settings": {"n_lobes": 4, "max_iterations": 1},
    }  # fmt: skip
    axes = {"settings.max_error": [0.9, 1e-6]}
    request, context = study_of(base, axes, own)
    with pytest.raises(SettingsError, match=r"settings\.max_error = 1e-06: .*cannot be met"):
        run_stages(REGISTRY.stages("study", request, context), store)
    request, context = study_of(base, axes, own, skip_illegal=True)
    done = run_stages(REGISTRY.stages("study", request, context), store)
    result = REGISTRY.finish("study", request, context, done).result
    assert (result["points"], result["skipped"]) == (1, 1)


def test_what_only_the_transfer_can_refuse(compression, store):
    """An error that no sizes meet: the request is well formed."""
    base, own = compression
    axes = {"settings.n_clusters": [2], "settings.max_error": [1e-30, 0.1]}
    request, context = study_of(base, axes, own)
    with pytest.raises(SettingsError, match="cannot be met") as refused:
        run_stages(REGISTRY.stages("study", request, context), store)
    assert "settings.max_error = 1e-30" in refused.value.detail
    request, context = study_of(base, axes, own, skip_illegal=True)
    done = run_stages(REGISTRY.stages("study", request, context), store)
    finished = REGISTRY.finish("study", request, context, done)
    assert (finished.result["points"], finished.result["skipped"]) == (1, 1)
    assert (
        "point 0 was left out: a squared error of 1e-30 cannot be met"
        in finished.result["notes"][0]
    )
    (kept,) = json.loads(store.read_bytes(done["report"][0]["files"]["study.json"]))["points"]
    assert kept["point"] == 1
    request, context = study_of(base, {"settings.max_error": [1e-30]}, own, skip_illegal=True)
    with pytest.raises(SettingsError, match="no point can be run"):
        run_stages(REGISTRY.stages("study", request, context), store)


def test_bytes_that_hold_no_lobe_are_left_out(ball, store):
    body, own, _ = ball
    base = {
        "kind": "fit_light", "environment": body["environment"],
        "settings": {"n_lobes": 4, "max_iterations": 1},
    }  # fmt: skip
    request, context = study_of(base, {"settings.max_bytes": [100, 5000]}, own, skip_illegal=True)
    done = run_stages(REGISTRY.stages("study", request, context), store)
    result = REGISTRY.finish("study", request, context, done).result
    assert (result["points"], result["skipped"]) == (1, 1)
    assert "a light of one lobe takes" in result["notes"][0]


@pytest.mark.parametrize(
    ("settings", "n_lists"),
    [
        ({"method": "cpca", "max_error": 0.01}, 1),
        ({"classification": "adaptive", "ranks": [2, 8, 4], "step_tasks": 2}, 5),
    ],
    ids=["one task", "shared steps"],
)
def test_registers_that_only_the_fit_can_refuse_are_left_out(compression, store, settings, n_lists):
    base, own = compression
    base = base | {"settings": base["settings"] | {"n_clusters": 6, **settings}}
    axes = {"settings.registers": [2, 1000]}
    request, context = study_of(base, axes, own, skip_illegal=True)
    done = run_stages(REGISTRY.stages("study", request, context), store)
    result = REGISTRY.finish("study", request, context, done).result
    assert (result["points"], result["skipped"]) == (1, 1)
    assert re.search(r"registers is 2: cluster \d+ takes", result["notes"][0])
    assert len(done.rounds("compress")) >= n_lists


def test_points_that_are_rounded_otherwise_share_their_factors(compression, store):
    base, own = compression
    axes = {"settings.n_clusters": [4], "settings.bits": [8, 16]}
    request, context = study_of(base, axes, own)
    done = run_stages(REGISTRY.stages("study", request, context), store)
    assert [len(done[name]) for name in ("compress", "quantise")] == [1, 2]
    points = json.loads(store.read_bytes(done["report"][0]["files"]["study.json"]))["points"]
    assert points[0]["bytes"] < points[1]["bytes"]
    assert points[0]["error"] > points[1]["error"] > 0
    assert points[0]["stages"]["compress"]["shared_seconds"] > 0
    # no bits meet so small a bound: the file's writing is the first to see it
    axes = {"settings.max_quantisation_error": [1e-2, 1e-30]}
    request, context = study_of(base, axes, own, skip_illegal=True)
    done = run_stages(REGISTRY.stages("study", request, context), store)
    (skipped,) = json.loads(store.read_bytes(done["report"][0]["files"]["study.json"]))["skipped"]
    assert skipped["point"] == 1
    assert "16 bits" in skipped["reason"]


def test_a_study_taken_up_again_asks_for_the_same_tasks(compressed):
    """A recovered parent lists the stages anew; what it gets from the results so far is the same."""
    request, context, results = compressed
    first, second = (REGISTRY.stages("study", request, context) for _ in range(2))
    whole = Results()
    for one, other in zip(first, second, strict=True):
        tasks = one.tasks(whole)
        assert len({task.key for task in tasks}) == len(tasks)
        part = Results()  # as the second walk has them: another object
        for name in whole:
            part.add(name, whole[name], whole.measured(name))
        assert [task.key for task in other.tasks(part)] == [task.key for task in tasks]
        whole.add(one.name, results[one.name], results.measured(one.name))


def test_the_estimate_counts_shared_work_once(ball, compression, store):
    body, own, _ = ball
    base = body | {"kind": "asset"}
    request, context = study_of(base, {"settings.compress.n_clusters": [2, 6]}, own)
    parsed = job_request_adapter.validate_python(request)
    found = study_estimate.predict(parsed, context, store, predict)
    alone = predict(parsed.points()[0].request, normal(base), own, store)
    assert found["seconds"]["bake"] == pytest.approx(alone.seconds["bake"])
    assert found["seconds"]["fit_light"] == pytest.approx(alone.seconds["fit_light"])
    assert found["seconds"]["validate"] == pytest.approx(2 * alone.seconds["validate"])
    assert found["seconds"]["compress"] > alone.seconds["compress"]
    axes = {"settings.bake.term_energy_lost": [0.1, 1e-9]}
    request, context = study_of(base, axes, own)
    with pytest.raises(SettingsError, match=r"settings\.bake\.term_energy_lost"):
        study_estimate.predict(
            job_request_adapter.validate_python(request), context, store, predict
        )
    request, context = study_of(base, axes, own, skip_illegal=True)
    parsed = job_request_adapter.validate_python(request)
    plan = study_estimate.predict(parsed, context, store, predict)["plan"]
    assert (len(plan["points"]), len(plan["skipped"])) == (1, 1)


def toy(start, *, third=False):
    """Two or three stages that count from a number; the second depends on the first's parity."""

    def first(_):
        return [Task("m:f", {"n": start})]

    def second(results):
        return [Task("m:g", {"n": results["first"][0]["n"] % 2, "i": i}) for i in range(2)]

    stages = [Stage("first", "n", 1.0, first), Stage("second", "n", 1.0, second)]
    return [*stages, Stage("third", "n", 1.0, lambda _: [])] if third else stages


def counting(to, *, step=1):
    """A stage that repeats: a round a number up to ``to``, then one that looks at the last."""

    def count(results):
        done = results.rounds("count")
        return [Task("m:f", {"n": len(done) * step})] if len(done) < to else []

    def last(results):
        return [Task("m:g", {"n": results["count"][0]["n"]})]

    rounds = Rounds(lambda _: to, lambda results: results.rounds("count")[-1].values)
    return [Stage("count", "n", 1.0, count, rounds), Stage("last", "n", 1.0, last)]


def test_jobs_repeat_a_stage_as_often_as_each_needs():
    jobs = [counting(2), counting(4), counting(3, step=10)]
    shared = SharedStages(jobs, list("abc"), skip_refused=False)
    count, last = shared.stages()
    results, asked = Results(), []
    assert count.rounds.most(results) == 4
    for tasks in count.lists(results):
        asked.append([task.args["n"] for task in tasks])
        costs = [Measured(float(task.args["n"]), 1) for task in tasks]
        results.add_round("count", [task.args for task in tasks], costs)
    # the first two have rounds in common, which are run once
    assert asked == [[0], [1, 10], [2, 20], [3]]
    assert [task.args["n"] for task in last.tasks(results)] == [1, 3, 20]
    shares = shared.shares(results)
    for share, numbers in zip(shares, ([0, 1], [0, 1, 2, 3], [0, 10, 20]), strict=True):
        assert [cost.seconds for cost in share.results.measured("count")] == numbers
        assert len(share.keys["count"]) == len(numbers)
    assert shared.shared_keys(results) == set(shares[0].keys["count"])


def test_tasks_are_run_once_and_their_results_dealt_out():
    shared = SharedStages([toy(1), toy(2), toy(3, third=True)], list("abc"), skip_refused=False)
    stages = shared.stages()
    assert [stage.name for stage in stages] == ["first", "second", "third"]
    results = Results()
    tasks = stages[0].tasks(results)
    assert [task.args["n"] for task in tasks] == [1, 2, 3]
    results.add("first", [task.args for task in tasks], [None] * 3)
    tasks = stages[1].tasks(results)
    assert [task.args for task in tasks] == [
        {"n": 1, "i": 0}, {"n": 1, "i": 1}, {"n": 0, "i": 0}, {"n": 0, "i": 1},
    ]  # fmt: skip
    results.add("second", [task.args for task in tasks], [None] * 4)
    shares = shared.shares(results)
    assert [share.results["second"][1]["n"] for share in shares] == [1, 0, 1]
    assert shares[0].keys["second"] == shares[2].keys["second"]
    assert shared.shared_keys(results) == set(shares[0].keys["second"])


def test_lists_of_stages_are_merged_in_order():
    assert merged([["a", "d"], ["a", "b", "d"], ["b", "c", "d", "e"]]) == list("abcde")
    with pytest.raises(ValueError, match="different places"):
        merged([["a", "b"], ["b", "a"]])
