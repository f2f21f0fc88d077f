"""Which service a command talks to, and what its errors mean for the exit code."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import typer
from pydantic import ValidationError
from rich.markup import escape

from prtbake.cli.exits import Exit, exit_of
from prtbake.cli.output import Output, messages
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
    output = context.params.get("output", Output.text)
    with reporting(output), Client(target.url, key=target.key, data_dir=target.data_dir) as client:
        yield client


@contextmanager
def reporting(output: Output = Output.text) -> Iterator[None]:
    """Turn errors into a message on standard error, text or JSON, and an exit code."""
    try:
        yield
    except KeyboardInterrupt:
        raise typer.Exit(Exit.interrupted) from None
    except ValidationError as error:
        for entry in error.errors():
            where = f"/{'/'.join(str(step) for step in entry['loc'])}"
            _say(f"{where}: {entry['msg']}", Exit.usage, output)
        raise typer.Exit(Exit.usage) from None
    except PrtbakeError as error:
        lines = [str(error), *getattr(error, "__notes__", ())]
        _say(
            "\n".join(lines), code_of(error), output, error if isinstance(error, ApiError) else None
        )
        raise typer.Exit(code_of(error)) from None
    except BrokenPipeError:
        raise typer.Exit(Exit.error) from None  # nobody reads on, `head` has what it wanted
    except OSError as error:
        _say(str(error), Exit.error, output)
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


def _say(text: str, code: Exit, output: Output, answer: ApiError | None = None) -> None:
    if output is Output.text:
        messages().print(f"[red]error:[/] {escape(text)}")
        if answer is not None and answer.request_id:
            messages().print(f"[dim]request {escape(answer.request_id)}[/]")
        return
    told: dict[str, Any] = {"error": text, "exit_code": int(code)}
    if answer is not None:
        problem = answer.problem.model_dump(mode="json", exclude_none=True)
        told |= {"problem": problem, "request_id": answer.request_id}
    typer.echo(json.dumps(told), err=True)
