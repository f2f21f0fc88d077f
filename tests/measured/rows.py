"""Tables of dataclasses in CSV: what a run measured, for the runs and pages after it."""

import csv
from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import TypeAdapter

AnyRow = TypeVar("AnyRow")


def write_rows(path: Path, rows: Sequence[Any], kind: type, *, digits: int = 17) -> None:
    """Write a table anew, figures to some significant digits; 17 keep every bit."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [one.name for one in fields(kind)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(_cells(row, digits) for row in rows)


def append_rows(path: Path, rows: Sequence[Any], kind: type) -> None:
    """Append to a table, which is begun where it is not there."""
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [one.name for one in fields(kind)], lineterminator="\n")
        if file.tell() == 0:
            writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def read_rows(path: Path, kind: type[AnyRow]) -> list[AnyRow]:
    """Read a table; no rows where it is not there."""
    if not path.exists():
        return []
    types, row_of = get_type_hints(kind), TypeAdapter(kind)
    with path.open(newline="", encoding="utf-8") as file:
        return [
            row_of.validate_python(
                {
                    name: None if value == "" and types[name] is not str else value
                    for name, value in line.items()
                }
            )
            for line in csv.DictReader(file)
        ]


def _cells(row: Any, digits: int) -> dict[str, Any]:
    return {
        name: f"{value:.{digits}g}" if isinstance(value, float) and digits < 17 else value
        for name, value in asdict(row).items()
    }
