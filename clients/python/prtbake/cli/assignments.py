"""``--set path.to.field=value``."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import typer
from pydantic import ValidationError


def parse_value(text: str) -> Any:
    """Read a value: JSON if it is, a list if it has commas, else the text itself."""
    text = text.strip()
    try:
        return json.loads(text)
    except json.JSONDecodeError:
        pass
    if text.lower() == "none":
        return None
    if "," in text:
        return [parse_value(part) for part in text.split(",")]
    return text


def nested(pairs: list[str]) -> dict[str, Any]:
    """Read ``a.b=value`` pairs into nested dictionaries; later ones win."""
    tree: dict[str, Any] = {}
    for pair in pairs:
        path, equals, text = pair.partition("=")
        steps = path.strip().split(".")
        if not equals or not all(steps):
            raise typer.BadParameter(f"{pair!r} is not path.to.field=value", param_hint="--set")
        node = tree
        for step in steps[:-1]:
            inner = node.setdefault(step, {})
            if not isinstance(inner, dict):
                raise typer.BadParameter(f"{step!r} has a value already", param_hint="--set")
            node = inner
        node[steps[-1]] = parse_value(text)
    return tree


def one_of(*legal: str) -> Callable[[str | None], str | None]:
    """Return a callback that refuses an option's value unless it is one of these, or not given."""

    def check(value: str | None) -> str | None:
        if value is not None and value not in legal:
            raise typer.BadParameter(f"{value!r} is none of {', '.join(legal)}")
        return value

    return check


def legal_names(
    given: dict[str, Any],
    legal: Iterable[str],
    owner: str,
    option: str,
    *,
    below: Mapping[str, Iterable[str]] | None = None,
) -> dict[str, Any]:
    """Return the values if all their names are legal; else say which is not and which would be.

    ``below`` has the names that stand under a legal one, to tell those that want it before them.
    """
    names = list(legal)
    for name in given:
        if name not in names:
            meant = [f"{first}.{name}" for first, inner in (below or {}).items() if name in inner]
            raise typer.BadParameter(
                f"{owner} has no {name!r}; "
                + (f"write {' or '.join(meant)}" if meant else f"it has: {', '.join(names)}"),
                param_hint=option,
            )
    return given


@contextmanager
def refusing(option: str) -> Iterator[None]:
    """Turn what a model refuses into the refusal of the option that said it."""
    try:
        yield
    except ValidationError as error:
        complaints = [
            ": ".join([*(str(step) for step in entry["loc"]), entry["msg"]])
            for entry in error.errors()
        ]
        raise typer.BadParameter("; ".join(complaints), param_hint=option) from error


def read_json(text: str, option: str) -> Any:
    """Read JSON that stands behind an option."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise typer.BadParameter(f"not JSON: {error}", param_hint=option) from error
