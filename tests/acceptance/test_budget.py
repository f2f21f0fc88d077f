"""Budgets over REST, by real workers: met, kept and refused."""

from typing import Any

import pytest

from prtbake_storage.contract.jobs import JobState
from prtbake_storage.contract.resources import MeshRegistration
from support.deployment import Installation

pytestmark = pytest.mark.acceptance

SETTINGS: dict[str, Any] = {
    "bake": {"cube_resolution": 8, "n_centres": 42},
    "compress": {"max_iterations": 2},
    "render": {"width": 32, "height": 24},
    "validation": {"width": 32, "height": 24, "passes": 4, "samples": 32},
}


def ball_request(installation: Installation, budget: dict[str, float]) -> dict[str, Any]:
    builtin = {"name": "icosphere", "tessellation": 2}
    mesh = installation.client.register(MeshRegistration.model_validate({"builtin": builtin}))
    return {
        "kind": "asset", "mesh": mesh.id, "brdf": {"model": "lambert", "albedo": 0.7},
        "environment": installation.environment, "budget": budget, "settings": SETTINGS,
    }  # fmt: skip


def test_an_error_is_met_at_held_out_views(local: Installation) -> None:
    request = ball_request(local, {"max_error": 0.2})
    estimate = local.client.estimate(request)
    assert any("searched from quality draft on" in one for one in estimate.warnings)
    job = local.client.wait(local.client.submit(request).id)
    assert job.state is JobState.succeeded, job.error
    assert job.result is not None
    assert job.result["budget"]["total"] <= 0.2
    attempts = job.result["search"]["attempts"]
    assert {one["name"].split(",")[0] for one in attempts} == {"bake", "light", "compression"}
    assert {"asset.h5", "light.h5", "report.html"} <= {file.name for file in job.artefacts}


def test_seconds_are_kept(local: Installation) -> None:
    job = local.client.wait(local.client.submit(ball_request(local, {"max_seconds": 90.0})).id)
    assert job.state is JobState.succeeded, job.error
    assert job.started is not None
    assert job.finished is not None
    assert (job.finished - job.started).total_seconds() <= 1.1 * 90.0
    assert job.result is not None
    assert job.result["search"]["attempts"][-1]["why"]


def test_a_second_is_refused_with_the_least(local: Installation) -> None:
    submitted = local.client.submit(ball_request(local, {"max_seconds": 1.0}))
    job = local.client.wait(submitted.id, check=False)
    assert job.state is JobState.failed
    assert job.error is not None
    assert (job.error.kind, job.error.pointer) == ("input", "/budget/max_seconds")
    assert "is predicted to take" in job.error.detail


def test_bytes_are_kept_or_refused_at_their_field(local: Installation) -> None:
    request = ball_request(local, {"max_bytes": 30_000}) | {"quality": "draft"}
    job = local.client.wait(local.client.submit(request).id)
    assert job.state is JobState.succeeded, job.error
    (size,) = (file.size for file in job.artefacts if file.name == "asset.h5")
    assert 27_000 <= size <= 30_000
    few = ball_request(local, {"max_bytes": 900})
    job = local.client.wait(local.client.submit(few).id, check=False)
    assert job.error is not None
    assert (job.error.kind, job.error.pointer) == ("input", "/budget/max_bytes")
    assert "the mesh alone takes more than" in job.error.detail


def test_a_lone_bake_keeps_an_error_bytes_and_a_time(local: Installation) -> None:
    budget = {"max_error": 0.25, "max_bytes": 10_000_000, "max_seconds": 120.0}
    ball = ball_request(local, budget)
    request = {name: ball[name] for name in ("mesh", "brdf", "budget")} | {
        "kind": "bake",
        "receiver": {"resolution": 8},
        "effects": {"interreflection": "off"},
    }
    estimate = local.client.estimate(request)
    assert "the first bake for the budget" in estimate.warnings[0]
    job = local.client.wait(local.client.submit(request).id)
    assert job.state is JobState.succeeded, job.error
    assert job.result is not None
    assert job.result["search"]["error"] <= 0.25
    assert job.result["search"]["binds"]
    (transfer,) = (file for file in job.artefacts if file.name == "transfer.h5")
    assert transfer.size == job.result["bytes"]["transfer.h5"] <= 10_000_000
    assert job.started is not None
    assert job.finished is not None
    assert (job.finished - job.started).total_seconds() <= 1.1 * 120.0
