"""``prtbake serve``: service and workers on this machine."""

import signal
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from prtbake.cli.context import reporting, target_of
from prtbake.cli.output import messages
from prtbake.config import home
from prtbake.launch import LocalService

PORT = 8420


def serve(
    context: typer.Context,
    data_dir: Annotated[
        Path | None, typer.Option(help="Home of database, blobs, key and logs.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Worker processes.")] = 2,
    host: Annotated[str, typer.Option(help="Address; the loopback by default.")] = "127.0.0.1",
    port: Annotated[
        int, typer.Option(min=0, envvar="PRTBAKE_PORT", help="Port; 0 takes a free one.")
    ] = PORT,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Logs on this terminal, not in files.")
    ] = False,
) -> None:
    """Serve until Ctrl-C or SIGTERM; then everything is stopped in order."""
    folder = home(data_dir or target_of(context).data_dir)
    # from here on SIGTERM unwinds like Ctrl-C, so that the processes are stopped
    # SIGINT too: a shell script starts its background processes with it ignored
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, raise_interrupt)
    out = messages()
    with reporting():
        try:
            with LocalService(
                folder, n_workers=workers, host=host, port=port, verbose=verbose
            ) as service:
                out.print(f"prtbake serves at [bold]{service.url}[/] with {workers} workers")
                out.print(f"page: {service.page}")
                out.print(f"data: {folder}")
                service.run()
        except KeyboardInterrupt:
            out.print("stopped")


def raise_interrupt(number: int, frame: FrameType | None) -> None:
    """Handle a signal as Ctrl-C is handled."""
    del number, frame
    raise KeyboardInterrupt
