"""The command ``prtbake``."""

import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from prtbake.cli import files, jobs
from prtbake.cli.calibrate import calibrate
from prtbake.cli.context import Target
from prtbake.cli.demo import demo
from prtbake.cli.exits import LEGEND
from prtbake.cli.serve import serve
from prtbake.cli.submit import estimate_group, submit_group
from prtbake_storage import __version__

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=LEGEND,
    help="Bake, compress and relight precomputed radiance transfer.",
)


def print_version(asked: bool) -> None:
    """Print the version and end, if that is asked."""
    if asked:
        typer.echo(f"prtbake {__version__}")
        raise typer.Exit


@app.callback()
def options(
    context: typer.Context,
    url: Annotated[
        str | None, typer.Option(help="The service; else PRTBAKE_URL, else a local one.")
    ] = None,
    key: Annotated[
        str | None, typer.Option(envvar="PRTBAKE_API_KEY", help="An API key.", show_envvar=True)
    ] = None,
    data_dir: Annotated[
        Path | None, typer.Option(help="Data directory of a local service.")
    ] = None,
    version: Annotated[
        bool,
        typer.Option("--version", callback=print_version, is_eager=True, help="Print it and end."),
    ] = False,
) -> None:
    """Keep what all commands need."""
    del version
    context.obj = Target(url, key, data_dir)


app.add_typer(submit_group, name="submit")
app.add_typer(estimate_group, name="estimate")
app.add_typer(files.register_group, name="register")
app.command()(demo)
app.command()(serve)
app.command()(calibrate)
app.command()(jobs.wait)
app.command()(jobs.watch)
app.command()(jobs.logs)
app.command("get")(files.get)
app.command()(jobs.cancel)
app.command()(jobs.retry)
app.command("ls")(jobs.list_jobs)
app.command("show")(jobs.show_job)
app.command("rm")(jobs.remove)
app.command()(files.upload)


def main() -> None:
    """Run the command line."""
    try:
        app()
    finally:
        try:
            sys.stdout.flush()
        except BrokenPipeError:
            # what is left has no reader; Python would complain of it when it closes the stream
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


if __name__ == "__main__":
    main()
