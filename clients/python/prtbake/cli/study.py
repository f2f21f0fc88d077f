"""The words of a study on the command line: a request to vary, and what varies."""

from typing import Annotated, Any

import typer

from prtbake.cli.assignments import parse_value
from prtbake.cli.options import Label, Priority, Timeout
from prtbake.cli.requests import Request
from prtbake.cli.sources import read_request
from prtbake.client import Client


def study(
    client: Client,
    *,
    base: Annotated[
        str, typer.Argument(help="The request to vary, as JSON; - reads standard input.")
    ],
    axis: Annotated[
        list[str],
        typer.Option(
            metavar="PATH=...",
            help="Values of a field, as settings.n_clusters=16,32; repeat for several axes.",
        ),
    ],
    skip_illegal: Annotated[
        bool, typer.Option("--skip-illegal", help="Leave out values that do not go together.")
    ] = False,
    label: Label = None,
    priority: Priority = 50,
    timeout: Timeout = None,
) -> Request:
    """Run a request at every combination of some values: error against seconds and bytes."""
    del client
    common: dict[str, Any] = {"label": label, "priority": priority, "timeout_s": timeout}
    return {
        "kind": "study",
        "base": read_request(base, "BASE"),
        "axes": axes_of(axis),
        "skip_illegal": skip_illegal,
        **{name: value for name, value in common.items() if value is not None},
    }


def axes_of(words: list[str]) -> list[dict[str, Any]]:
    """Read ``PATH=VALUES``; values are a JSON list, or stand between commas."""
    axes = []
    for word in words:
        path, equals, text = word.partition("=")
        if not equals or not path.strip():
            raise typer.BadParameter(f"{word!r} is not PATH=VALUES", param_hint="--axis")
        values = parse_value(text)
        axes.append(
            {"path": path.strip(), "values": values if isinstance(values, list) else [values]}
        )
    return axes
