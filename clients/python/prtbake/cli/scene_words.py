"""What ``--receiver``, ``--subsurface`` and ``--tangents`` say of a scene."""

from typing import Any

import typer
from pydantic import ValidationError

from prtbake.cli.assignments import legal_names, parse_value, read_json
from prtbake.cli.sources import key_values
from prtbake_storage.contract.materials import Subsurface
from prtbake_storage.contract.settings import ReceiverPlane


def receiver_value(text: str) -> dict[str, Any]:
    """Read ``--receiver``: ``on``, a resolution, pairs, or JSON, where it has a BRDF of its own."""
    if text == "on":
        return {}
    if text.startswith("{"):
        given = read_json(text, "--receiver")
        return legal_names(given, ReceiverPlane.model_fields, "the plane", "--receiver")
    if "=" not in text:
        return {"resolution": parse_value(text)}
    given = key_values(text.split(","))
    return legal_names(given, ReceiverPlane.model_fields, "the plane", "--receiver")


def medium_value(text: str) -> dict[str, Any]:
    """Read ``--subsurface``: a medium's name and ``mm_per_unit``, parameters, or JSON."""
    if text.startswith("{"):
        given = read_json(text, "--subsurface")
    else:
        name, *pairs = text.split(",")
        given = {} if "=" in name else {"medium": name}
        given |= key_values([name, *pairs] if "=" in name else pairs)
    given = legal_names(given, Subsurface.model_fields, "the medium", "--subsurface")
    try:
        Subsurface.model_validate(given)
    except ValidationError as error:
        complaints = [
            ": ".join([*(str(place) for place in entry["loc"][:1]), entry["msg"]])
            for entry in error.errors()
        ]
        raise typer.BadParameter("; ".join(complaints), param_hint="--subsurface") from error
    return given


def tangents_value(text: str) -> str | list[float]:
    """Read ``--tangents``: a word, or a direction as x:y:z."""
    if text in ("horizontal", "uv"):
        return text
    try:
        x, y, z = (float(number) for number in text.split(":"))
    except ValueError as error:
        raise typer.BadParameter(
            "write horizontal, uv, or a direction as 0:1:0", param_hint="--tangents"
        ) from error
    return [x, y, z]
