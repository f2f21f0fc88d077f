"""Requests that an OpenAPI document describes, and requests that come close to them."""

import re
from collections.abc import Mapping
from functools import cache
from typing import Any

from hypothesis import strategies as st

Schema = Mapping[str, Any]

# what databases, clocks, encoders and float parsers are known to trip over
ODD_TEXT = st.sampled_from(["\0", "a\0b", "\ud800", "'; --", "é" * 40, "x" * 400, "../..", "%00"])
ODD_TIME = st.sampled_from(
    ["0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "2026-02-30T00:00:00Z", "0"]
)
ODD_NUMBER = st.sampled_from([0, -1, 2**31, 2**63, 10**30, -0.0, 1e308, float("nan"), float("inf")])
ODD = st.one_of(
    ODD_TEXT, ODD_TIME, ODD_NUMBER, st.none(), st.booleans(), st.just([]), st.just({"\0": {}})
)
ODDITIES = 12
"""One value in so many is odd."""


STRANGE = st.integers(1, ODDITIES).map(lambda n: n == 1)


def values(schema: Schema, document: Schema) -> st.SearchStrategy[Any]:
    """Values that a schema allows, now and then with something odd in their place."""
    # built when first drawn, and once: every draw of a job's request passes through hundreds
    allowed = cache(lambda: _allowed(schema, document))
    return STRANGE.flatmap(lambda odd: ODD if odd else allowed())


def _allowed(schema: Schema, document: Schema) -> st.SearchStrategy[Any]:
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return values(document["components"]["schemas"][name], document)
    for choice in ("anyOf", "oneOf"):
        if choice in schema:
            return st.one_of([values(option, document) for option in schema[choice]])
    if "const" in schema:
        return st.just(schema["const"])
    if "enum" in schema:
        return st.sampled_from(schema["enum"])
    match schema.get("type"):
        case "object":
            return _objects(schema, document)
        case "array":
            return _arrays(schema, document)
        case "string":
            return _strings(schema)
        case "integer":
            return st.sampled_from([int(bound) for bound in _bounds(schema)])
        case "number":
            return st.floats(*_bounds(schema))
        case "boolean":
            return st.booleans()
        case "null":
            return st.none()
    return ODD


def _bounds(schema: Schema) -> tuple[float, float]:
    low = schema.get("minimum", schema.get("exclusiveMinimum"))
    high = schema.get("maximum", schema.get("exclusiveMaximum"))
    if low is None:
        low = 0.0 if high is None else min(0.0, high)
    return low, low + 100.0 if high is None else high


def _objects(schema: Schema, document: Schema) -> st.SearchStrategy[Any]:
    if isinstance(schema.get("additionalProperties"), Mapping):
        keys = st.one_of(st.text(max_size=20), ODD_TEXT)
        return st.dictionaries(keys, values(schema["additionalProperties"], document), max_size=3)
    properties = schema.get("properties", {})
    # the tag of a union is never left out: nothing behind it would be looked at
    needed = set(schema.get("required", ())) | ({"kind", "model"} & set(properties))
    fields = {name: values(inner, document) for name, inner in properties.items()}
    return st.fixed_dictionaries(
        {name: field for name, field in fields.items() if name in needed},
        optional={name: field for name, field in fields.items() if name not in needed},
    )


def _arrays(schema: Schema, document: Schema) -> st.SearchStrategy[Any]:
    if "prefixItems" in schema:
        return st.tuples(*[values(item, document) for item in schema["prefixItems"]])
    items = values(schema.get("items", {}), document)
    return st.lists(items, min_size=schema.get("minItems", 0), max_size=3)


def _strings(schema: Schema) -> st.SearchStrategy[str]:
    if schema.get("format") == "date-time":
        return st.datetimes().map(lambda moment: f"{moment.isoformat()}Z")
    if "pattern" in schema and schema.get("maxLength", 0) <= 200:
        return st.from_regex(re.compile(schema["pattern"]), fullmatch=True)
    return st.text(max_size=min(schema.get("maxLength", 20), 20))
