"""Studies over REST, by real workers: shared work, and a cancelled study taken up again."""

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from prtbake_storage.contract.jobs import Job, JobState
from support.deployment import Installation, until
from support.main_job import BAKE, GLOSSY, SETTINGS, Finished

pytestmark = pytest.mark.acceptance

FILES = {"study.json", "study.csv", "frontier.png", "study.html", "report.json", "report.html"}


def compression(undisturbed: Finished, **settings: Any) -> dict[str, Any]:
    return {
        "kind": "compress", "transfer": f"{undisturbed.job.id}/transfer.h5",
        "settings": {"max_iterations": 2, "threads": 1} | settings,
    }  # fmt: skip


def table_of(local: Installation, job: Job, folder: Path) -> dict[str, Any]:
    assert job.state is JobState.succeeded, job.error
    found: dict[str, Any] = json.loads(
        local.client.download(job.id, "study.json", folder).read_text()
    )
    return found


def test_a_study_of_compressions(
    local: Installation, undisturbed: Finished, tmp_path: Path
) -> None:
    """From the command line: two by three points of one transfer."""
    request = tmp_path / "base.json"
    request.write_text(json.dumps(compression(undisturbed)))
    folder = tmp_path / "files"
    told = local.command(
        "submit", "study", request, "--axis", "settings.n_clusters=2,6",
        "--axis", "settings.ranks=[[2,8,4],[4,16,8],[6,24,12]]",
        "--id", "six-compressions", "--to", folder,
    ).stdout  # fmt: skip
    assert "frontier: points that no other beats" in told
    assert {path.name for path in folder.iterdir()} == FILES
    job = local.client.job("six-compressions")
    table = table_of(local, job, folder)
    assert [point["point"] for point in table["points"]] == list(range(6))
    errors = [point["error"] for point in table["points"]]
    assert errors[0] > errors[1] > errors[2] > 0
    rows = list(csv.DictReader((folder / "study.csv").read_text().splitlines()))
    assert [float(row["error"]) for row in rows] == errors
    assert job.result is not None
    on = {point["point"] for point in job.result["frontier"]}
    assert on == set(table["frontier"]["seconds"]) | set(table["frontier"]["bytes"])
    # a point by itself: all of its work is done already, and its file is the point's
    alone = local.client.wait(local.client.submit(table["points"][4]["request"]).id)
    assert sum(local.starts(alone.id).values()) <= 3  # outline, file and report
    (asset,) = (file for file in alone.artefacts if file.name == "asset.h5")
    assert asset.size == table["points"][4]["bytes"]


def test_two_assets_of_one_scene_are_baked_once(local: Installation, tmp_path: Path) -> None:
    base = {
        "kind": "asset", "mesh": local.mesh, "brdf": GLOSSY, "environment": local.environment,
        "quality": "draft", "settings": SETTINGS | {"bake": BAKE | {"n_terms": 8}}, "seed": 7,
    }  # fmt: skip
    study = {"kind": "study", "base": base, "axes": {"settings.compress.n_clusters": [2, 6]}}
    predicted = local.client.estimate(study)
    assert predicted.plan["kind"] == "study"
    assert len(predicted.plan["points"]) == 2
    job = local.client.wait(local.client.submit(study).id)
    table = table_of(local, job, tmp_path)
    stages = {stage["name"]: stage["tiles"] for stage in table["stages"]}
    started = local.starts(job.id)
    # no task was begun twice, and no stage has another's
    assert set(started.values()) == {1}
    assert sum(started.values()) == sum(stages.values()) + 1  # and the report
    n_tiles = sum(len(part["tiles"]) for part in alone_plan(local, base))
    assert stages["bake"] == n_tiles
    assert (stages["plan"], stages["join"], stages["compress"]) == (2, 1, 2)
    bakes = [point["stages"]["bake"] for point in table["points"]]
    assert bakes[0] == bakes[1]
    assert bakes[0]["shared_seconds"] == bakes[0]["seconds"] > 0
    assert all(point["error"] > 0 for point in table["points"])


def alone_plan(local: Installation, base: dict[str, Any]) -> list[dict[str, Any]]:
    parts: list[dict[str, Any]] = local.client.estimate(base).plan["parts"]
    return parts


def test_a_cancelled_study_goes_on_where_it_was(
    local: Installation, undisturbed: Finished, tmp_path: Path
) -> None:
    base = compression(undisturbed, max_iterations=30, ranks=[8, 48, 24], n_clusters=8)
    seeds = list(range(100, 106))
    study = {"kind": "study", "base": base, "axes": {"seed": seeds}}
    first = local.client.submit(study)

    def done(job: str, stage: int = 1) -> set[int]:
        found = local.log(job, "task.done")
        return {one["position"] for one in found if one["stage"] == stage}

    until(lambda: len(done(first.id)) >= 3, "three compressed parts")
    local.client.cancel(first.id)
    assert local.client.wait(first.id, check=False).state is JobState.canceled
    kept = done(first.id)
    assert 3 <= len(kept) < 2 * len(seeds)
    again = local.client.wait(local.client.retry(first.id).id)
    assert again.retry_of == first.id
    begun = {position for stage, position in local.starts(again.id) if stage == 1}
    # every part of every point but those that were done, or all but: each of the two workers may
    # have been stopped between doing one and remembering it
    assert set(range(2 * len(seeds))) - kept <= begun
    assert len(begun & kept) <= 2
    table = table_of(local, again, tmp_path)
    assert [point["values"]["seed"] for point in table["points"]] == seeds
    # the points that were kept are points like the others
    assert all(0 < point["error"] < 1 for point in table["points"])


def test_illegal_axes_are_refused_in_words(
    local: Installation, undisturbed: Finished, tmp_path: Path
) -> None:
    request = tmp_path / "base.json"
    request.write_text(json.dumps(compression(undisturbed, n_clusters=2)))
    options = ["submit", "study", request, "--axis", "settings.method=cta,vpca"]
    assert 'settings.method = "vpca"' in local.command(*options, code=6).stderr
    # this one only its transfer forbids: no sizes bring so small an error
    options = ["submit", "study", request, "--axis", "settings.max_error=0.1,1e-30", "--wait"]
    told = local.command(*options, code=3)
    assert "settings.max_error = 1e-30" in told.stdout + told.stderr
    told = local.command(*options, "--skip-illegal")
    assert "cannot be met" in told.stdout
