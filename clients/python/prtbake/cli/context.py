"""Which service a command talks to, and what its errors mean for the exit code."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import typer
from pydantic import ValidationError
from rich.markup import escape

from prtbake.cli.exits import Exit, exit_of
from prtbake.cli.output import messages
from prtbake.client import Client
from prtbake.errors import (
    ApiError,
    DownloadError,
    JobNotSucceeded,
    PrtbakeError,
    ServiceFailed,
    ServiceUnreachable,
    WaitTimeout,
)


@dataclass(frozen=True)
class Target:
    """The service that the global options name."""

    url: str | None = None
    key: str | None = None
    data_dir: Path | None = None


def target_of(context: typer.Context) -> Target:
    """Return what the global options say."""
    root = context.find_root()
    return root.obj if isinstance(root.obj, Target) else Target()


@contextmanager
def client_of(context: typer.Context) -> Iterator[Client]:
    """Open a client; turn errors into a message and an exit code."""
    target = target_of(context)
    with reporting(), Client(target.url, key=target.key, data_dir=target.data_dir) as client:
        yield client


@contextmanager
def reporting() -> Iterator[None]:
    """Turn errors into a message on standard error and an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(Exit.interrupted) from None
    except ValidationError as error:
        for entry in error.errors():
            _say(f"/{'/'.join(str(step) for step in entry['loc'])}: {entry['msg']}")
        raise typer.Exit(Exit.usage) from None
    except PrtbakeError as error:
        _say(str(error))
        if isinstance(error, ApiError) and error.request_id:
            messages().print(f"[dim]request {escape(error.request_id)}[/]")
        raise typer.Exit(code_of(error)) from None
    except BrokenPipeError:
        raise typer.Exit(Exit.error) from None  # nobody reads on, `head` has what it wanted
    except OSError as error:
        _say(str(error))
        raise typer.Exit(Exit.error) from None


def code_of(error: PrtbakeError) -> Exit:
    """Return the exit code for an error of the SDK."""
    match error:
        case JobNotSucceeded():
            return exit_of(error.job.state)
        case ServiceFailed():
            return Exit.service
        case ApiError():
            return Exit.refused
        case ServiceUnreachable():
            return Exit.unreachable
        case WaitTimeout():
            return Exit.timeout
        case DownloadError():
            return Exit.corrupt
        case _:
            return Exit.error


def _say(text: str) -> None:
    messages().print(f"[red]error:[/] {escape(text)}")
