"""What commands print: tables for people, JSON for programs.

Data goes to standard output, everything else to standard error, so that ``-o json`` can be piped.
"""

import json
import sys
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Any

import typer
from pydantic import BaseModel
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from prtbake_storage.contract.jobs import Estimate, Job

PIPE_WIDTH = 200
_STYLES = {"succeeded": "green", "failed": "red", "expired": "red", "running": "cyan"}


class Output(StrEnum):
    """How data is printed."""

    text = "text"
    json = "json"


OutputOption = Annotated[
    Output, typer.Option("--output", "-o", metavar="FORMAT", help="Print data as text or json.")
]


def console() -> Console:
    """Return the console on standard output, as it is now."""
    # a pipe has no width, and rich's guess of 80 would cut ids short
    width = None if sys.stdout.isatty() else PIPE_WIDTH
    return Console(highlight=False, soft_wrap=True, width=width)


def messages() -> Console:
    """Return the console on standard error, as it is now."""
    return Console(stderr=True, highlight=False, soft_wrap=True)


def print_json(value: BaseModel | Sequence[BaseModel] | dict[str, Any]) -> None:
    """Print one JSON document."""
    if isinstance(value, BaseModel):
        plain: Any = value.model_dump(mode="json")
    elif isinstance(value, dict):
        plain = value
    else:
        plain = [item.model_dump(mode="json") for item in value]
    typer.echo(json.dumps(plain, indent=2))


def print_job(job: Job, output: Output) -> None:
    """Print a job: in text its id, state and what came of it."""
    if output is Output.json:
        print_json(job)
        return
    out = console()
    out.print(f"[bold]{job.id}[/]  {colour(job.state)}  {escape(job.label or job.kind)}")
    if job.error:
        where = f" (at {job.error.pointer})" if job.error.pointer else ""
        out.print(f"  {escape(f'{job.error.detail}{where} [{job.error.code}]')}")
    for artefact in job.artefacts:
        out.print(f"  {artefact.name}  {human_bytes(artefact.size)}")


def print_jobs(jobs: Sequence[Job], output: Output) -> None:
    """Print a list of jobs."""
    if output is Output.json:
        print_json(jobs)
        return
    table = Table(box=None, pad_edge=False)
    table.add_column("job", no_wrap=True)
    for heading in ("kind", "state", "progress", "created", "label"):
        table.add_column(heading)
    for job in jobs:
        table.add_row(
            job.id,
            job.kind,
            colour(job.state),
            f"{job.progress.fraction:.0%}",
            job.created.astimezone().strftime("%Y-%m-%d %H:%M"),
            escape(job.label or ""),
        )
    console().print(table)


def print_estimate(estimate: Estimate, output: Output) -> None:
    """Print what a job would do and cost."""
    if output is Output.json:
        print_json(estimate)
        return
    out = console()
    parts = []
    if estimate.total_seconds is not None:
        parts.append(f"about [bold]{human_seconds(estimate.total_seconds)}[/]")
    if estimate.artefact_bytes:
        parts.append(f"{human_bytes(sum(estimate.artefact_bytes.values()))} of artefacts")
    if estimate.artefact_bytes_at_most:
        most = human_bytes(sum(estimate.artefact_bytes_at_most.values()))
        parts.append(f"at most {most} of pictures and reports")
    if estimate.peak_memory_bytes is not None:
        parts.append(f"{human_bytes(estimate.peak_memory_bytes)} of memory at the peak")
    out.print(", ".join(parts) or "its inputs fit; what it costs is not predicted")
    table = Table(box=None, pad_edge=False)
    table.add_column("stage")
    table.add_column("seconds of work", justify="right")
    for stage, seconds in estimate.seconds.items():
        table.add_row(stage, f"{seconds:.1f}")
    if table.row_count:
        out.print(table)
    for name, error in estimate.errors.items():
        out.print(f"  expected error, {escape(name)}: {error:.3%}")
    for warning in estimate.warnings:
        out.print(f"  [yellow]{escape(warning)}[/]")


def colour(state: str) -> str:
    """Return a state in its colour."""
    style = _STYLES.get(state)
    return f"[{style}]{state}[/]" if style else str(state)


def human_bytes(count: float) -> str:
    """Write a count of bytes for people."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if abs(count) < 1024 or unit == "GiB":
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1024
    raise AssertionError("the last unit returns")


def human_seconds(seconds: float) -> str:
    """Write a duration for people."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s"
