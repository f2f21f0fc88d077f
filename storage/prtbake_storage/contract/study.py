"""The axes of a study: values that are laid over a request, point by point."""

import json
from collections.abc import Mapping, Sequence
from itertools import product
from math import prod
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    JsonValue,
    ValidationError,
    field_validator,
)

from prtbake_storage.contract.base import Wire

MOST_POINTS = 256
"""Of a study: the product of all axes' values."""

FIXED = ("kind", "label", "priority", "timeout_s")
"""Fields that say nothing of a point."""

MOST_CHARACTERS = 4096
"""Of a value's JSON: every point and every table repeats it."""

SHOWN = 60
"""Characters of a value that a sentence quotes."""

Values = dict[str, JsonValue]
"""Path -> value: where a point stands on every axis."""


class Axis(Wire):
    """A field of the base request and the values that it takes, one after the other."""

    path: Annotated[
        str, Field(max_length=200, pattern=r"^[A-Za-z0-9_-]{1,64}(\.[A-Za-z0-9_ -]{1,64}){0,7}$")
    ]
    """Names from the request down to the field, as `settings.compress.n_clusters`."""
    values: Annotated[list[JsonValue], Field(min_length=1, max_length=64)]
    """What stands there, whatever the base has; JSON of any kind that the field takes."""

    @field_validator("path")
    @classmethod
    def _varied(cls, path: str) -> str:
        if path.partition(".")[0] in FIXED:
            raise ValueError(f"{path} cannot be an axis: it says nothing of a point")
        return path

    @field_validator("values")
    @classmethod
    def _stored(cls, values: list[JsonValue]) -> list[JsonValue]:
        """Refuse what a database would, and a value that stands twice."""
        first: dict[str, int] = {}
        for place, value in enumerate(values):
            text = json.dumps(value, allow_nan=False, sort_keys=True, ensure_ascii=False)
            if len(text) > MOST_CHARACTERS:
                raise ValueError(
                    f"value {place} is {len(text)} characters of JSON: {MOST_CHARACTERS} at most"
                )
            if r"\u0000" in text or any("\ud800" <= character <= "\udfff" for character in text):
                raise ValueError(f"value {place} holds a character that is no text")
            if (other := first.setdefault(text, place)) != place:
                raise ValueError(f"values {other} and {place} are both {shown(value)}")
        return values


def _as_list(axes: Any) -> Any:
    """Read ``{path: values}`` as the list that it is short for."""
    if isinstance(axes, Mapping):
        return [{"path": path, "values": values} for path, values in axes.items()]
    return axes


def _independent(axes: list[Axis]) -> list[Axis]:
    """Refuse too many points, and axes of which one would overwrite the other."""
    paths = [axis.path for axis in axes]
    for place, path in enumerate(paths):
        for other in paths[place + 1 :]:
            if f"{path}.".startswith(f"{other}.") or f"{other}.".startswith(f"{path}."):
                raise ValueError(f"the axes {path} and {other} set the same field")
    if (count := prod(len(axis.values) for axis in axes)) > MOST_POINTS:
        raise ValueError(f"the axes have {count} points together: at most {MOST_POINTS}")
    return axes


Axes = Annotated[
    list[Axis],
    Field(min_length=1, max_length=8),
    AfterValidator(_independent),
    BeforeValidator(_as_list, json_schema_input_type=list[Axis] | dict[str, list[JsonValue]]),
]
"""A list of axes, or ``{path: values}``."""


def grid(axes: Sequence[Axis]) -> list[Values]:
    """List every combination of the axes' values; the last axis changes fastest."""
    paths = [axis.path for axis in axes]
    return [
        dict(zip(paths, values, strict=True)) for values in product(*(axis.values for axis in axes))
    ]


def laid_over(base: Mapping[str, Any], values: Values) -> dict[str, Any]:
    """Return the base with values in the places that their paths name.

    Raises
    ------
    ValueError
        Where a path leads through something that is no object.
    """
    laid = dict(base)
    for path, value in values.items():
        *steps, last = path.split(".")
        node = laid
        for step in steps:
            inner = node.get(step)
            if not isinstance(inner, dict | None):
                # as all that pydantic is to report
                raise ValueError(  # noqa: TRY004
                    f"{path}: {step} is {shown(inner)} there, which has no fields"
                )
            node[step] = dict(inner or {})
            node = node[step]
        node[last] = value
    return laid


def describe(values: Values) -> str:
    """Name a point by its values, for people."""
    return ", ".join(f"{path} = {shown(value)}" for path, value in values.items())


def shown(value: Any) -> str:
    """Write a value as JSON, cut to what a sentence can hold."""
    text = json.dumps(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def first_fault(error: ValueError) -> str:
    """Say what is wrong with a request, and where in it."""
    if not isinstance(error, ValidationError):
        return str(error)
    (first, *_) = error.errors(include_url=False)
    where = ".".join(map(str, first["loc"]))
    return f"{where}: {first['msg']}"
