"""``prtbake demo``: the main job on this machine, start to end."""

import json
import signal
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from prtbake.cli.context import reporting, target_of
from prtbake.cli.exits import exit_of
from prtbake.cli.options import Quality as QualityOption
from prtbake.cli.output import (
    Output,
    OutputOption,
    console,
    human_bytes,
    human_seconds,
    messages,
    print_job,
    print_json,
)
from prtbake.cli.progress import show
from prtbake.cli.report import asset_bytes, print_result, total_error, total_seconds
from prtbake.cli.serve import raise_interrupt
from prtbake.client import Client
from prtbake.config import home
from prtbake.launch import LocalService
from prtbake_storage.contract.brdf import CookTorranceSpec
from prtbake_storage.contract.jobs import AssetRequest, Job, JobState
from prtbake_storage.contract.resources import (
    BuiltinEnvironment,
    BuiltinMesh,
    EnvironmentRegistration,
    MeshRegistration,
)
from prtbake_storage.contract.settings import Quality, ReceiverPlane

LADDER: tuple[Quality, ...] = ("draft", "medium", "high")
LADDER_VALIDATION = {"width": 192, "height": 144, "passes": 8, "samples": 128}
"""The same measurement for every rung, so that the rungs can be compared."""
MAKING = ("plan", "bake", "join", "compress", "quantise", "fit_light")
"""Stages that make the asset; the rest of a job looks at it."""
BRDF = CookTorranceSpec(m=0.5, kd=0.3, ks=0.7, f0=0.1)


def demo(
    context: typer.Context,
    quality: QualityOption = "medium",
    ladder: Annotated[
        bool, typer.Option("--ladder", help="Draft, medium and high beside each other.")
    ] = False,
    to: Annotated[Path, typer.Option(help="Folder for everything that comes out.")] = Path(
        "demo-output"
    ),
    tessellation: Annotated[int, typer.Option(min=1, max=64, help="Of the teapot.")] = 12,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 2,
    data_dir: Annotated[
        Path | None, typer.Option(help="Keep database and blobs here; else they are temporary.")
    ] = None,
    output: OutputOption = Output.text,
) -> None:
    """Bake a teapot of Cook-Torrance under a procedural sky, and account for error and time."""
    signal.signal(signal.SIGTERM, raise_interrupt)
    say = messages()
    given = data_dir or target_of(context).data_dir
    with reporting(output), _folder(given) as folder:
        say.print(f"starting the service and {workers} workers")
        with LocalService(folder, n_workers=workers, embedded=given is None) as service:
            say.print(f"page: {service.page}")
            with Client(service.url, key=service.key) as client:
                if ladder:
                    same = {"validation": LADDER_VALIDATION}
                    jobs = [_run(client, rung, tessellation, to / rung, same) for rung in LADDER]
                    rungs = [_rung(*pair) for pair in zip(LADDER, jobs, strict=True)]
                    (to / "ladder.json").write_text(json.dumps({"ladder": rungs}, indent=2))
                    print_ladder(rungs, to, output)
                else:
                    jobs = [_run(client, quality, tessellation, to)]
                    _print_one(jobs[0], to, output)
    for job in jobs:
        if job.state is not JobState.succeeded:
            raise typer.Exit(exit_of(job.state))


@contextmanager
def _folder(given: Path | None) -> Iterator[Path]:
    if given is not None:
        yield home(given)
        return
    with tempfile.TemporaryDirectory(prefix="prtbake-demo-") as temporary:
        yield Path(temporary)


def _run(
    client: Client,
    quality: str,
    tessellation: int,
    to: Path,
    settings: Mapping[str, Any] | None = None,
) -> Job:
    say = messages()
    builtin = BuiltinMesh(name="teapot", tessellation=tessellation)
    mesh = client.register(MeshRegistration(builtin=builtin))
    sky = client.register(EnvironmentRegistration(builtin=BuiltinEnvironment(name="sun_sky")))
    request = AssetRequest.model_validate(
        {
            "label": f"demo teapot, {quality}",
            "mesh": mesh.id,
            "brdf": BRDF,
            "environment": sky.id,
            "receiver": ReceiverPlane(),
            "quality": quality,
            "settings": settings or {},
        }
    )
    job = client.submit(request)
    say.print(f"job {job.id}: {quality}")
    job = show(client.follow(job.id))
    if job.state is JobState.succeeded:
        client.download_all(job.id, to)
    return job


def _print_one(job: Job, to: Path, output: Output) -> None:
    print_job(job, output)
    if job.state is not JobState.succeeded:
        return
    if output is Output.text and job.result:
        print_result(job.result)
    say = messages()
    say.print(f"took {human_seconds(total_seconds(job))}; everything is in {to}")
    report = to / "report.html"
    if report.exists():
        say.print(f"report: [bold]{report}[/]")


def print_ladder(rungs: list[dict[str, Any]], to: Path, output: Output) -> None:
    """Print the qualities beside each other, and on standard error what lies where."""
    done = [to / rung["quality"] for rung in rungs if rung["state"] == "succeeded"]
    where = f"this table: {to / 'ladder.json'}"
    if done:
        where += f"; the files of each job, report.html among them: {', '.join(map(str, done))}"
    messages().print(escape(where))
    if output is Output.json:
        print_json({"ladder": rungs})
        return
    table = Table(title="accuracy and what it costs", title_justify="left")
    table.add_column("quality")
    for heading in ("making it", "job, validation too", "asset", "error", "noise"):
        table.add_column(heading, justify="right")
    for rung in rungs:
        size, error, noise = rung["bytes"], rung["error"], rung["noise"]
        done = rung["state"] == "succeeded"
        table.add_row(
            rung["quality"] if done else f"{rung['quality']}: {rung['state']}",
            f"{rung['making_seconds']:.1f} s",
            f"{rung['seconds']:.1f} s",
            "" if size is None else human_bytes(size),
            "" if error is None else f"{error:.3%}",
            "" if noise is None else f"{noise:.3%}",
        )
    console().print(table)
    console().print(
        "error: relative L2 of the same validation pictures for every quality; "
        "making it: seconds of work before anything looks at the asset"
    )


def _rung(quality: str, job: Job) -> dict[str, Any]:
    result = job.result or {}
    return {
        "quality": quality,
        "job": job.id,
        "state": job.state.value,
        "making_seconds": round(sum(result.get("seconds", {}).get(s, 0.0) for s in MAKING), 3),
        "seconds": round(total_seconds(job), 3),
        "bytes": asset_bytes(job),
        "error": total_error(result),
        "noise": (result.get("budget") or {}).get("total_noise"),
    }
