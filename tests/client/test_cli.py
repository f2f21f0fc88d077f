"""The command line against a real service: what it prints, what it exits with."""

import json
import os
import re
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import pytest
import typer
from click.testing import Result
from typer.testing import CliRunner

from prtbake.cli.calibrate import print_rates
from prtbake.cli.exits import LEGEND, Exit
from prtbake.cli.main import app
from prtbake_service.testing import LiveService
from prtbake_storage import __version__
from prtbake_storage.contract.jobs import JobError, JobState, Progress
from prtbake_storage.contract.resources import BuiltinEnvironment, BuiltinMesh
from prtbake_storage.records import Stop

Run = Callable[..., Result]
RESULT = {
    "budget": {
        "lines": [{"name": "basis", "error": 0.02, "below_noise": True}],
        "total": 0.015,
    },
    "errors": {"compress": {"object": 0.004}},
    "bytes": {"asset.h5": 2048},
    "seconds": {"bake": 61.0},
    "effects": [{"effect": "self_shadowing", "taken": True, "reason": "not [convex]"}],
    "notes": ["K is cut to [8] terms"],
}


@pytest.fixture
def submitted(run: Run, environment: str) -> str:
    result = run("submit", "fit-light", "--environment", environment, "-o", "json")
    assert result.exit_code == 0, result.output
    return str(json.loads(result.stdout)["id"])


def test_calibrate_submits_and_prints_the_rates(
    run: Run, service: LiveService, capsys: pytest.CaptureFixture[str]
) -> None:
    made = run("calibrate", "--no-wait", "-o", "json")
    assert made.exit_code == 0, made.output
    assert json.loads(made.stdout)["kind"] == "calibrate"
    print_rates(
        {
            "seconds": {"bake": {"rays": 1.25e-7, "tasks": 0.9}},
            "stages": [{"stage": "bake", "measured": 2.0, "predicted": 2.1, "shipped": 4.0}],
        }
    )
    printed = capsys.readouterr().out
    for words in ("bake", "2.00", "2.10", "4.00", "rays", "1.25e-07"):
        assert words in printed


def test_a_study_is_told_as_its_frontier(run: Run, service: LiveService, submitted: str) -> None:
    point = {
        "point": 3, "values": {"settings.n_lobes": 8}, "error": 0.0125, "noise": None,
        "seconds": 2.0, "shared_seconds": 0.0, "bytes": 2048, "frontier": ["seconds", "bytes"],
    }  # fmt: skip
    service.succeed(submitted, {"frontier": [point], "error_is": "what is left"})
    told = run("show", submitted).stdout
    for text in ("1.250%", "2.0 s", "2.0 KiB", "settings.n_lobes = 8", "what is left"):
        assert text in told


def test_submit_and_wait(run: Run, service: LiveService, environment: str, tmp_path: Path) -> None:
    def work() -> None:
        while not (queued := service.backend.jobs.page(label="waited").items):
            pass
        job = queued[0].id
        service.begin(job)
        service.runs.progress(job, Progress(stage="fit", fraction=0.5))
        service.succeed(job, RESULT, light_h5=b"light")

    threading.Thread(target=work, daemon=True).start()
    result = run(
        *("submit", "fit-light", "--environment", environment, "--label", "waited"),
        *("--to", tmp_path / "out"),
    )
    assert result.exit_code == 0, result.output
    assert (tmp_path / "out" / "light.h5").read_bytes() == b"light"
    assert "succeeded" in result.stdout
    # progress is for people and stays out of what is piped
    assert "100% succeeded" in result.stderr
    assert "100%" not in result.stdout
    told = ("1.500%", "2.000% *", "0.400%", "1 min 1 s", "2.0 KiB", "not [convex]")
    for text in (
        *told,
        "* below the noise",
        "relative L2",
        "squared error",
        "K is cut to [8] terms",
    ):
        assert text in result.stdout
    assert "K is cut to [8] terms" in run("show", queued_id(service)).stdout


def queued_id(service: LiveService) -> str:
    return str(service.backend.jobs.page(label="waited").items[0].id)


@pytest.mark.parametrize("command", ["wait", "watch"])
@pytest.mark.parametrize(
    ("state", "code"),
    [
        (JobState.succeeded, 0),
        (JobState.failed, Exit.failed),
        (JobState.canceled, Exit.canceled),
        (JobState.expired, Exit.expired),
    ],
)
def test_the_exit_code_tells_the_state(
    run: Run, service: LiveService, submitted: str, command: str, state: JobState, code: int
) -> None:
    if state is JobState.succeeded:
        service.succeed(submitted, {})
    elif state is JobState.canceled:
        assert run("cancel", submitted).exit_code == 0
    else:
        service.begin(submitted)
        error = JobError(kind="input", code="bad", detail="too [few] lobes", pointer="/settings")
        service.runs.close(submitted, Stop(state, error))
    result = run(command, submitted)
    assert result.exit_code == code
    assert state in result.stdout
    if state is JobState.failed:
        assert "too [few] lobes (at /settings) [bad]" in result.stdout
    as_json = run(command, submitted, "-o", "json")
    assert json.loads(as_json.stdout)["state"] == state
    assert as_json.exit_code == code


def test_waiting_has_an_end(run: Run, submitted: str) -> None:
    assert run("wait", submitted, "--timeout", 0.1).exit_code == Exit.timeout


def test_no_star_no_legend(run: Run, service: LiveService, submitted: str) -> None:
    lines = [{"name": "basis", "error": 0.02, "below_noise": False}]
    service.succeed(submitted, RESULT | {"budget": {"lines": lines}, "notes": []})
    told = run("show", submitted).stdout
    assert "2.000%" in told
    assert "*" not in told
    assert "notes" not in told


def test_cancel_says_what_had_ended(run: Run, service: LiveService, submitted: str) -> None:
    first = run("cancel", submitted)
    assert "had ended" not in first.stderr
    again = run("cancel", submitted, "-o", "json")
    assert again.exit_code == 0
    assert f"{submitted} had ended" in again.stderr
    assert json.loads(again.stdout)["state"] == "canceled"


def test_help_keeps_its_syntax_at_80_columns(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    for kind in ("asset", "bake", "fit-light", "validate"):
        told = CliRunner().invoke(app, ["submit", kind, "--help"]).output
        assert "…" not in told
        assert "words on the command" in told
    told = CliRunner().invoke(app, ["submit", "asset", "--help"]).output
    for word in ("builtin:teapot:12", "builtin:sun_sky,width=256", "lambert,albedo=0.5:0.3:0.2"):
        assert word in told


def test_ls(run: Run, submitted: str) -> None:
    assert submitted in run("ls").stdout
    listed = json.loads(run("ls", "--state", "queued", "-n", 2, "-o", "json").stdout)
    assert listed[0]["id"] == submitted
    assert len(listed) == 2
    assert json.loads(run("ls", "--label", "nobody's", "-o", "json").stdout) == []


def test_logs(run: Run, service: LiveService, submitted: str) -> None:
    first = run("logs", submitted)
    assert first.exit_code == 0
    assert "queued" in first.stdout
    service.begin(submitted)
    service.backend.events.log(submitted, "said [something]")
    service.succeed(submitted, {})
    text = run("logs", submitted, "--follow").stdout
    assert "said [something]" in text
    lines = run("logs", submitted, "-o", "json").stdout.splitlines()
    assert [json.loads(line)["type"] for line in lines] == ["state", "state", "log", "state"]


def test_get(run: Run, service: LiveService, submitted: str, tmp_path: Path) -> None:
    service.succeed(submitted, {}, a_bin=b"a" * 10, b_bin=b"b")
    one = run("get", submitted, "b.bin", "--to", tmp_path, "-o", "json")
    assert json.loads(one.stdout)["files"] == {"b.bin": str(tmp_path / "b.bin")}
    assert not (tmp_path / "a.bin").exists()
    assert run("get", submitted, "--to", tmp_path).exit_code == 0
    assert (tmp_path / "a.bin").read_bytes() == b"a" * 10
    missing = run("get", submitted, "c.bin", "--to", tmp_path)
    assert missing.exit_code == Exit.error
    assert "a.bin, b.bin" in missing.stderr


def test_get_of_a_job_without_files_is_no_success(
    run: Run, service: LiveService, environment: str, tmp_path: Path
) -> None:
    def submit() -> str:
        made = run("submit", "fit-light", "--environment", environment, "-o", "json")
        return str(json.loads(made.stdout)["id"])

    job = submit()
    waiting = run("get", job, "--to", tmp_path)
    assert (waiting.exit_code, waiting.stdout) == (Exit.error, "")
    assert "is queued: it has no files" in waiting.stderr
    run("cancel", job)
    assert run("get", job, "--to", tmp_path).exit_code == Exit.canceled
    job = submit()
    service.fail(job, JobError(kind="input", code="bad", detail="too few lobes"))
    failed = run("get", job, "light.h5", "--to", tmp_path)
    assert failed.exit_code == Exit.failed
    assert "too few lobes" in failed.stderr


def test_a_reader_may_leave_early(run: Run, service: LiveService, submitted: str) -> None:
    """As ``prtbake logs JOB | head -1`` does."""
    service.succeed(submitted, {})
    for command in (["logs", submitted, "-o", "json"], ["watch", submitted], ["show", submitted]):
        reader, writer = os.pipe()
        os.close(reader)
        target = ["--url", service.url, "--key", service.key]
        told = subprocess.run(
            [sys.executable, "-m", "prtbake.cli.main", *target, *command],
            stdout=writer, stderr=subprocess.PIPE, text=True, check=False,
        ).stderr  # fmt: skip
        os.close(writer)
        assert "roken" not in told
        assert "Traceback" not in told


def test_version() -> None:
    result = CliRunner().invoke(app, ["--version"])
    assert (result.exit_code, result.stdout) == (0, f"prtbake {__version__}\n")


def test_get_of_damaged_bytes(
    run: Run, service: LiveService, submitted: str, tmp_path: Path
) -> None:
    service.succeed(submitted, {}, a_bin=b"right")
    (tmp_path / "a.bin.part").write_bytes(b"wrong")
    assert run("get", submitted, "--to", tmp_path).exit_code == Exit.corrupt
    assert run("get", submitted, "--to", tmp_path).exit_code == 0


def test_retry_show_rm(run: Run, submitted: str) -> None:
    run("cancel", submitted)
    again = json.loads(run("retry", submitted, "-o", "json").stdout)
    assert again["retry_of"] == submitted
    assert run("show", again["id"]).exit_code == 0
    assert run("rm", submitted).exit_code == 0
    assert run("show", submitted).exit_code == Exit.refused


def test_upload_and_register(run: Run, service: LiveService, tmp_path: Path) -> None:
    path = tmp_path / "ball.obj"
    path.write_text("v 0 0 0\n")
    uploaded = json.loads(run("upload", path, "-o", "json").stdout)
    assert uploaded[0]["size"] == 8
    canonical = service.backend.blobs.put_bytes(b"mesh")
    result = {"canonical": canonical, "understood": {"vertices": 1, "repairs": ["[none]"]}}
    service.answer_next("register", lambda job: service.succeed(job, result))
    registered = run("register", "mesh", path)
    assert registered.exit_code == 0, registered.output
    assert "vertices: 1" in registered.stdout
    assert "[none]" in registered.stdout


@pytest.mark.parametrize("options", [[], ["--crease-angle", 0.5], ["--crease-angle", 180]])
@pytest.mark.parametrize(
    "words",
    [
        ["register", "mesh", "FILE"],
        ["submit", "bake", "--mesh", "FILE", "--brdf", "lambert"],
        ["submit", "bake", "--mesh", "builtin:teapot:7", "--brdf", "lambert"],
    ],
    ids=["register", "submit", "built-in"],
)
def test_the_crease_angle_goes_into_the_registration(
    run: Run, service: LiveService, tmp_path: Path, words: list[str], options: list[object]
) -> None:
    path = tmp_path / "ball.obj"
    # a registration that the service knows would start no job
    path.write_text(f"# {tmp_path}\nv 0 0 0\n")
    seen = []

    def answer(job_id: str) -> None:
        seen.append(service.backend.jobs.get(job_id).request["registration"]["crease_angle_deg"])
        canonical = service.backend.blobs.put_bytes(b"mesh")
        service.succeed(job_id, {"canonical": canonical, "understood": {}})

    service.answer_next("register", answer)
    result = run(*[path if word == "FILE" else word for word in words], *options)
    assert result.exit_code == 0, result.output
    assert seen == [options[1] if options else None]


def test_estimate(run: Run, service: LiveService, environment: str) -> None:
    estimate = {
        "plan": {},
        "seconds": {"fit": 75.0},
        "total_seconds": 75.0,
        "artefact_bytes": {"light.h5": 4096},
        "artefact_bytes_at_most": {},
        "peak_memory_bytes": 1 << 30,
        "errors": {"fit": 0.05},
        "warnings": ["a black [sky]"],
    }
    service.answer_next("estimate", lambda job: service.succeed(job, estimate))
    text = run("estimate", "fit-light", "--environment", environment).stdout
    for part in ("1 min 15 s", "4.0 KiB", "1.0 GiB", "5.000%", "a black [sky]"):
        assert part in text
    service.answer_next("estimate", lambda job: service.succeed(job, estimate))
    result = run("estimate", "fit-light", "--environment", environment, "-o", "json")
    assert json.loads(result.stdout) == estimate
    unknown = estimate | {"total_seconds": None, "artefact_bytes": {}, "peak_memory_bytes": None}
    service.answer_next("estimate", lambda job: service.succeed(job, unknown | {"seconds": {}}))
    text = run("estimate", "fit-light", "--environment", environment).stdout
    assert "not predicted" in text
    assert "0 B" not in text


def test_every_exit_code_is_documented() -> None:
    for code in Exit:
        if code is not Exit.interrupted:
            assert f"{code.value} " in LEGEND


def test_all_commands_have_help() -> None:
    text = CliRunner().invoke(app, ["--help"]).output
    readme = (Path(__file__).parents[2] / "README.md").read_text()
    listed = re.search(r"`prtbake --help` lists `([^`]+)`", readme)
    assert listed is not None
    names = listed[1].split()
    assert set(names) == set(typer.main.get_group(app).commands)
    for name in names:
        assert name in text
        assert CliRunner().invoke(app, [name, "--help"]).exit_code == 0


def test_the_result_may_hold_anything(run: Run, service: LiveService, submitted: str) -> None:
    odd: dict[str, Any] = {"budget": [], "errors": 3, "effects": "none", "seconds": None, "x": {}}
    service.succeed(submitted, odd)
    assert run("show", submitted).exit_code == 0


def test_a_url_given_by_hand_beats_that_of_the_data_directory(tmp_path):
    (tmp_path / "server.json").write_text('{"url": "http://127.0.0.1:1"}')
    result = CliRunner().invoke(
        app, ["--url", "http://127.0.0.1:2", "--data-dir", str(tmp_path), "ls"]
    )
    assert result.exit_code == Exit.unreachable
    assert "127.0.0.1:2" in result.output


def test_the_builtins_of_the_pages_exist() -> None:
    page = (Path(__file__).parents[2] / "docs" / "client.md").read_text()
    for model in (BuiltinMesh, BuiltinEnvironment):
        for name in get_args(model.model_fields["name"].annotation):
            assert name in page
