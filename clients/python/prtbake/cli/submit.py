"""``prtbake submit`` and ``prtbake estimate``."""

from pathlib import Path
from typing import Annotated, Any

import typer

from prtbake.cli.exits import exit_of
from prtbake.cli.output import Output, OutputOption, messages, print_estimate, print_job
from prtbake.cli.progress import show
from prtbake.cli.report import print_result
from prtbake.cli.requests import BUILDERS, request_commands
from prtbake.cli.study import study
from prtbake.client import Client
from prtbake_storage.contract.jobs import Job, JobState

submit_group = typer.Typer(no_args_is_help=True, help="Submit a job of a kind.")
estimate_group = typer.Typer(
    no_args_is_help=True, help="Say what a job would do and cost, without running it."
)


def submit(
    client: Client,
    request: dict[str, Any],
    *,
    job_id: Annotated[
        str | None,
        typer.Option("--id", metavar="ID", help="The job's id; submitting it again is safe."),
    ] = None,
    wait: Annotated[bool, typer.Option("--wait", "-w", help="Wait for its end.")] = False,
    to: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="Wait, then download everything into this folder."),
    ] = None,
    output: OutputOption = Output.text,
) -> None:
    """Submit, and wait and download if asked."""
    job = client.submit(request, job_id=job_id)
    if not wait and to is None:
        print_job(job, output)
        return
    finish(client, job, to, output)


def finish(client: Client, job: Job, to: Path | None, output: Output) -> None:
    """See a job to its end, print it, and end the command with the code of its state."""
    try:
        job = show(client.follow(job.id))
    except KeyboardInterrupt:
        messages().print(f"job {job.id} goes on; `prtbake wait {job.id}` takes it up again")
        raise
    if to is not None and job.state is JobState.succeeded:
        client.download_all(job.id, to)
    print_job(job, output)
    if output is Output.text and job.result:
        print_result(job.result)
    raise typer.Exit(exit_of(job.state))


def estimate(
    client: Client, request: dict[str, Any], *, output: OutputOption = Output.text
) -> None:
    """Estimate and print."""
    print_estimate(client.estimate(request), output)


for group, action in ((submit_group, submit), (estimate_group, estimate)):
    request_commands(group, action, BUILDERS | {"study": study})
