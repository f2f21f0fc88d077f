"""``wait watch logs cancel retry rm ls``: commands on jobs that are there."""

from typing import Annotated

import typer
from rich.markup import escape

from prtbake.cli.context import client_of
from prtbake.cli.exits import exit_of
from prtbake.cli.output import Output, OutputOption, console, messages, print_job, print_jobs
from prtbake.cli.progress import show
from prtbake.cli.report import print_result
from prtbake_storage.contract.jobs import Event

Job = Annotated[str, typer.Argument(metavar="JOB", help="The job's id.")]
Seconds = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", min=0.0, help="Give up after so many seconds."),
]


def wait(
    context: typer.Context, job: Job, timeout: Seconds = None, output: OutputOption = Output.text
) -> None:
    """Wait silently for a job to end; the exit code says how."""
    with client_of(context) as client:
        ended = client.wait(job, timeout_s=timeout, check=False)
    print_job(ended, output)
    raise typer.Exit(exit_of(ended.state))


def watch(
    context: typer.Context, job: Job, timeout: Seconds = None, output: OutputOption = Output.text
) -> None:
    """Show a job's progress until it ends; the exit code says how."""
    with client_of(context) as client:
        ended = show(client.follow(job, timeout_s=timeout))
    print_job(ended, output)
    if output is Output.text and ended.result:
        print_result(ended.result)
    raise typer.Exit(exit_of(ended.state))


def logs(
    context: typer.Context,
    job: Job,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on until it ends.")] = False,
    output: OutputOption = Output.text,
) -> None:
    """Print a job's history: states, progress and log lines; with -o json one event a line."""
    with client_of(context) as client:
        for event in client.events(job, follow=follow):
            if output is Output.json:
                typer.echo(event.model_dump_json())
            else:
                console().print(_line(event))


def cancel(context: typer.Context, job: Job, output: OutputOption = Output.text) -> None:
    """Ask for a job to stop; asking again, or too late, changes nothing."""
    with client_of(context) as client:
        ended = client.job(job).state.terminal
        found = client.cancel(job)
    print_job(found, output)
    if ended:
        messages().print(f"job {found.id} had ended: there was nothing to cancel")


def retry(context: typer.Context, job: Job, output: OutputOption = Output.text) -> None:
    """Go on with a job that failed, was canceled or expired: a new job that reuses its tiles."""
    with client_of(context) as client:
        print_job(client.retry(job), output)


def remove(
    context: typer.Context, jobs: Annotated[list[str], typer.Argument(metavar="JOB...")]
) -> None:
    """Remove jobs that have ended, and their artefacts."""
    with client_of(context) as client:
        for job in jobs:
            client.delete(job)


def show_job(context: typer.Context, job: Job, output: OutputOption = Output.text) -> None:
    """Print a job as it is now."""
    with client_of(context) as client:
        found = client.job(job)
    print_job(found, output)
    if output is Output.text and found.result:
        print_result(found.result)


def list_jobs(
    context: typer.Context,
    state: Annotated[list[str] | None, typer.Option(help="Only in this state; repeat.")] = None,
    kind: Annotated[str | None, typer.Option(help="Only of this kind.")] = None,
    label: Annotated[str | None, typer.Option(help="Only with this label.")] = None,
    limit: Annotated[int, typer.Option("--limit", "-n", min=1, help="At most so many.")] = 20,
    output: OutputOption = Output.text,
) -> None:
    """List jobs, newest first."""
    with client_of(context) as client:
        found = []
        for job in client.jobs(state=state, kind=kind, label=label):
            found.append(job)
            if len(found) == limit:
                break
    print_jobs(found, output)


def _line(event: Event) -> str:
    time = event.created.astimezone().strftime("%H:%M:%S")
    data = event.data
    match event.type:
        case "state":
            text = f"[bold]{data.get('state', '?')}[/]"
            if isinstance(error := data.get("error"), dict):
                text += f" {escape(str(error.get('detail', '')))}"
        case "progress":
            fraction = float(data.get("fraction", 0.0))
            text = f"{fraction:4.0%} {escape(str(data.get('stage', '')))}"
            if data.get("total"):
                text += f" {data.get('done', 0):g}/{data['total']:g} {data.get('unit', '')}"
        case "log":
            text = escape(str(data.get("message", data)))
    return f"[dim]{time}[/] {text}"
