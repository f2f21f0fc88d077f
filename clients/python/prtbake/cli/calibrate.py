"""``prtbake calibrate``: measure what work takes on this machine."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import typer
from rich.table import Table

from prtbake.cli.context import client_of
from prtbake.cli.exits import exit_of
from prtbake.cli.output import Output, OutputOption, console, print_job
from prtbake.cli.progress import show
from prtbake_storage.contract.jobs import CalibrateRequest, JobState


def calibrate(
    context: typer.Context,
    wait: Annotated[
        bool, typer.Option("--wait/--no-wait", help="Wait for its end and print the rates.")
    ] = True,
    output: OutputOption = Output.text,
) -> None:
    """Measure what work takes on the workers' machine: estimates go by it from then on.

    It makes small assets for about 80 seconds; nothing else should run meanwhile.
    """
    with client_of(context) as client:
        job = client.submit(CalibrateRequest())
        if wait:
            job = show(client.follow(job.id))
    print_job(job, output)
    if not wait:
        return
    if output is Output.text and job.state is JobState.succeeded and job.result:
        print_rates(job.result)
    raise typer.Exit(exit_of(job.state))


def print_rates(result: Mapping[str, Any]) -> None:
    """Print what each stage of the trials took, what the rates make of it, and the rates."""
    console().print(_stages(result["stages"]))
    console().print(_units(result["seconds"]))


def _stages(stages: Sequence[Mapping[str, Any]]) -> Table:
    table = Table(box=None, pad_edge=False, title="trials", title_justify="left")
    table.add_column("stage")
    for heading in ("seconds", "by these rates", "by the shipped ones"):
        table.add_column(heading, justify="right")
    for one in stages:
        table.add_row(
            str(one["stage"]),
            *(f"{float(one[name]):.2f}" for name in ("measured", "predicted", "shipped")),
        )
    return table


def _units(seconds: Mapping[str, Mapping[str, float]]) -> Table:
    table = Table(box=None, pad_edge=False, title="rates", title_justify="left")
    table.add_column("stage")
    table.add_column("unit")
    table.add_column("seconds each", justify="right")
    for stage, units in seconds.items():
        for unit, value in units.items():
            table.add_row(stage, unit, f"{value:.3g}")
    return table
