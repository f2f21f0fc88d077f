"""What the models refuse, as pointers into the request and sentences."""

from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

Error = ErrorDetails | dict[str, Any]
_PARAMETERS = ("query", "path", "header")
_NO_OBJECT = frozenset({"model_attributes_type", "model_type", "dict_type"})
_TAG = frozenset({"union_tag_invalid", "union_tag_not_found"})


def pointer_to(loc: Sequence[str | int], body: Any, *, missing: bool = False) -> str:
    """Turn the location of a validation error into a JSON pointer into the body.

    A union adds what it tried to the location, a tag or the name of a type.  Only what the body
    holds is a step of the pointer; with ``missing`` the last name is one too.
    """
    steps: list[str] = []
    cursor = body
    for place, step in enumerate(loc):
        if isinstance(cursor, dict) and isinstance(step, str):
            tag = place == 0 and step == cursor.get("kind")
            if step in cursor and not tag:
                cursor = cursor[step]
            elif tag or not missing or place < len(loc) - 1:
                continue
        elif isinstance(cursor, list) and isinstance(step, int):
            cursor = cursor[step] if step < len(cursor) else None
        else:
            continue
        steps.append(str(step).replace("~", "~0").replace("/", "~1"))
    return "".join(f"/{step}" for step in steps)


def wanted_of(body: FieldInfo) -> str:
    """Say what a request's body should be, by the fields that it needs, or else may have."""
    names = [str(body.discriminator)] if body.discriminator else []
    if isinstance(body.annotation, type) and issubclass(body.annotation, BaseModel):
        fields = body.annotation.model_fields
        names = [name for name, field in fields.items() if field.is_required()]
        if not names:
            return f"the body must be a JSON object with some of {', '.join(fields)}"
    return f"the body must be a JSON object with {', '.join(names)}"


def validation_entries(
    errors: Sequence[Error], body: Any, *, wanted: str = ""
) -> list[dict[str, Any]]:
    """Return one ``{pointer, detail}`` for each thing that is wrong, each pointer once.

    ``wanted`` is told where the body as a whole is missing or no object.

    Of a union's members those are heard that take what was given, be it wrong in itself: a number
    out of range is not told that it is no colour, nor an object that it is no id.
    """
    found = [(*_entry(error, body, wanted), _of_another_type(error)) for error in errors]
    # a parameter has the body's own pointer, and says nothing of the body
    of_body = [
        (where, unfit)
        for (where, _, unfit), error in zip(found, errors, strict=True)
        if not _of_parameter(error)
    ]
    entries: dict[str, dict[str, Any]] = {}
    for where, detail, other_type in found:
        if other_type and any(
            at.startswith(f"{where}/") or (at == where and not unfit) for at, unfit in of_body
        ):
            continue
        key = where or detail
        if key in entries:
            entries[key]["detail"] += f"; or: {detail}"
        else:
            entries[key] = {"pointer": where, "detail": detail}
    return list(entries.values())


def _entry(error: Error, body: Any, wanted: str) -> tuple[str, str]:
    """Return the pointer and the sentence of one error."""
    loc = list(error["loc"])
    source = loc.pop(0) if loc and loc[0] in ("body", *_PARAMETERS) else "body"
    kind, detail = error["type"], error["msg"]
    if kind == "json_invalid":
        return "", f"the body is not JSON: {error['ctx']['error']}"
    if source != "body":
        # not in the body: the name stands in the sentence, and there is nothing to point to
        return "", f"{source} parameter {'.'.join(map(str, loc))}: {detail}"
    if wanted and not loc and (kind == "missing" or kind in _NO_OBJECT):
        return "", wanted
    if kind in _NO_OBJECT:
        detail = "Input should be an object"
    if kind not in _TAG:
        return pointer_to(loc, body, missing=kind == "missing"), detail
    name = error["ctx"]["discriminator"].strip("'")
    pointer = f"{pointer_to(loc, body)}/{name}"
    if kind == "union_tag_not_found":
        return pointer, "Field required"
    return pointer, f"{error['ctx']['tag']!r} is none of {error['ctx']['expected_tags']}"


def _of_parameter(error: Error) -> bool:
    """Tell whether an error is of a query, path or header parameter and not of the body."""
    return bool(error["loc"]) and error["loc"][0] in _PARAMETERS


def _of_another_type(error: Error) -> bool:
    """Tell whether a value is refused for its type, as by members of a union it was not meant for.

    Such an error has others at its place, or below it, only if they come from other members.
    """
    if _of_parameter(error):
        return False
    if error["type"] == "literal_error":
        return not isinstance(error["input"], str)
    return str(error["type"]).endswith("_type")
