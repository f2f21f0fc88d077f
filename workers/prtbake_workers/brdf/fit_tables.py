"""Tables of published fits as CSV: one material a row, SGD or ABC by the names of the columns."""

import codecs
import csv
import io
import math
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from prtbake_storage.contract.brdf_fits import AbcSpec, SgdSpec
from prtbake_storage.errors import BrdfError

RGB = ("_r", "_g", "_b")
SGD_COLUMNS = {
    "rhoD": "rho_d",
    "rhoS": "rho_s",
    "alpha": "alpha",
    "p": "p",
    "f0": "f0",
    "f1": "f1",
    "kap": "kappa",
    "lambda": "lam",
    "c": "c",
    "k": "k",
    "theta0": "theta0",
}
"""Columns of an SGD table, each with a channel's suffix, and the fields that they fill."""

ABC_COLUMNS = {"kD": "kd", "A": "a"}
ABC_NUMBERS = {"B": "b", "C": "c", "ior": "ior"}
MAX_ROWS = 10_000
NAMES_SHOWN = 8


def is_fit_table(data: bytes) -> bool:
    """Tell whether the bytes begin with the header of such a table."""
    return data.removeprefix(codecs.BOM_UTF8).startswith(b"name,")


def read_fit_table(data: bytes, material: str | None) -> SgdSpec | AbcSpec:
    """Take one material's parameters out of a table.

    Parameters
    ----------
    data
        CSV with a header: ``name`` (and ``other_name``), then the columns of either model; further
        columns, such as the fit's own error, are left alone.
    material
        Name or other name of the row.

    Raises
    ------
    BrdfError
        No such material, or a number that is missing or beyond its range; names line and column.
    """
    try:
        text = data.decode("utf-8-sig")
        rows = csv.DictReader(io.StringIO(text), strict=True)
        columns = frozenset(rows.fieldnames or ())
        model = _model_of(columns)
        names: list[str] = []
        for row in rows:
            names.append(row["name"])
            if material is not None and material in (row["name"], row.get("other_name")):
                return _spec(row, model, rows.line_num)
            if len(names) > MAX_ROWS:
                raise BrdfError(f"the table has more than {MAX_ROWS} rows")
    except (UnicodeDecodeError, csv.Error) as error:
        raise BrdfError(f"the table is no CSV text: {error}") from error
    shown = ", ".join(names[:NAMES_SHOWN])
    more = f" and {len(names) - NAMES_SHOWN} more" if len(names) > NAMES_SHOWN else ""
    wanted = "name a material of" if material is None else f"there is no material {material!r} in"
    raise BrdfError(f"{wanted} the table: {shown}{more}", pointer="/material")


def _model_of(columns: frozenset[str]) -> type[SgdSpec] | type[AbcSpec]:
    """Tell the model from the columns; where some are missing, name them."""
    wanted: Mapping[type[SgdSpec] | type[AbcSpec], set[str]] = {
        SgdSpec: {name + suffix for name in SGD_COLUMNS for suffix in RGB},
        AbcSpec: {name + suffix for name in ABC_COLUMNS for suffix in RGB} | set(ABC_NUMBERS),
    }
    for model, needed in wanted.items():
        if needed <= columns:
            return model
    nearest = min(wanted, key=lambda model: len(wanted[model] - columns))
    missing = ", ".join(sorted(wanted[nearest] - columns))
    raise BrdfError(
        f"the table's header is neither that of SGD nor of ABC fits: for "
        f"{nearest.model_fields['model'].default} it lacks {missing}"
    )


def _spec(
    row: Mapping[str, Any], model: type[SgdSpec] | type[AbcSpec], line: int
) -> SgdSpec | AbcSpec:
    coloured = SGD_COLUMNS if model is SgdSpec else ABC_COLUMNS
    values: dict[str, Any] = {
        field: tuple(_number(row, column + suffix, line) for suffix in RGB)
        for column, field in coloured.items()
    }
    if model is AbcSpec:
        values |= {field: _number(row, column, line) for column, field in ABC_NUMBERS.items()}
    try:
        return model.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        place = "/".join(str(step) for step in first["loc"])
        raise BrdfError(f"line {line} ({row['name']}), {place}: {first['msg']}") from error


def _number(row: Mapping[str, Any], column: str, line: int) -> float:
    text = row[column]
    try:
        value = float(text)
    except (TypeError, ValueError):
        value = math.nan
    if not math.isfinite(value):
        raise BrdfError(f"line {line} ({row['name']}), column {column}: {text!r} is no number")
    return value
