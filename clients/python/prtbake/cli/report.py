"""The result of an asset job for people: budget, errors, time, bytes, effects."""

from collections.abc import Mapping, Sequence
from typing import Any, TypeGuard

from rich.markup import escape
from rich.table import Table

from prtbake.cli.output import console, human_bytes, human_seconds
from prtbake_storage.contract.jobs import Job

Result = Mapping[str, Any]


def print_result(result: Result) -> None:
    """Print what is there, and nothing about what is not."""
    tables = (_frontier(result), _budget(result), _errors(result), _costs(result), _effects(result))
    for table in tables:
        if table is not None and table.row_count:
            console().print(table)
    if _is_list(notes := result.get("notes")) and notes:
        console().print("notes")
        for note in notes:
            console().print(f"  [yellow]{escape(str(note))}[/]")


def total_error(result: Result) -> float | None:
    """Return the end-to-end error: the budget's measured total, else what is called a total."""
    for place in (result.get("budget"), result.get("errors")):
        if isinstance(place, Mapping):
            for name in ("measured_total", "total", "end_to_end"):
                if (value := _number(place.get(name))) is not None:
                    return value
    return None


def total_seconds(job: Job) -> float:
    """Return how long a job took, waiting for a worker left out."""
    if job.started and job.finished:
        return (job.finished - job.started).total_seconds()
    return job.progress.elapsed_s


def asset_bytes(job: Job) -> int | None:
    """Return the size of the compressed asset."""
    sizes = {artefact.name: artefact.size for artefact in job.artefacts}
    return sizes.get("asset.h5")


def _budget(result: Result) -> Table | None:
    budget = result.get("budget")
    if not isinstance(budget, Mapping):
        return None
    table = Table(
        title="error budget: relative L2 of the validation pictures",
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("line")
    table.add_column("relative L2", justify="right")
    table.add_column("noise", justify="right")
    listed = budget.get("lines")
    lines = [line for line in listed if isinstance(line, Mapping)] if _is_list(listed) else []
    stars = [line.get("below_noise") for line in lines]
    for line in lines:
        table.add_row(
            escape(str(line.get("name", "?"))),
            _percent(line.get("error"), starred=line.get("below_noise")),
            _percent(line.get("noise")),
        )
    table.add_section()
    table.add_row(
        "sum of the lines", _percent(sum(_number(line.get("error")) or 0 for line in lines))
    )
    for name in ("total", "measured_total"):
        if _number(budget.get(name)) is not None:
            stars.append(starred := budget.get(f"{name}_below_noise"))
            table.add_row(
                "measured total",
                _percent(budget[name], starred=starred),
                _percent(budget.get(f"{name}_noise")),
                style="bold",
            )
    captions = []
    if any(stars):
        captions.append("* below the noise of its measurement")
    if budget.get("black_reference"):
        captions.append(
            "the reference is black or lost in its noise: relative to the brightest picture"
        )
    table.caption = "\n".join(captions) or None
    return table


def _frontier(result: Result) -> Table | None:
    points = result.get("frontier")
    if not _is_list(points):
        return None
    table = Table(
        title="frontier: points that no other beats in error and cost",
        title_justify="left",
        caption=f"the error is {result.get('error_is')}",
        caption_justify="left",
    )
    for heading in ("point", "error", "time", "size"):
        table.add_column(heading, justify="right")
    table.add_column("of")
    table.add_column("values")
    for point in points:
        if isinstance(point, Mapping):
            values = point.get("values") or {}
            table.add_row(
                str(point.get("point")),
                _percent(point.get("error")),
                human_seconds(_number(point.get("seconds")) or 0.0),
                human_bytes(_number(point.get("bytes")) or 0.0),
                escape(", ".join(map(str, point.get("frontier") or ()))),
                escape(", ".join(f"{path} = {value}" for path, value in values.items())),
            )
    return table


def _errors(result: Result) -> Table | None:
    errors = _numbers(result.get("errors"))
    if not errors:
        return None
    table = Table(
        title="each stage's own error: squared, relative to what the stage was given",
        title_justify="left",
        caption="squared: 1 % here is a relative L2 of 10 %; report.json says of what and to what",
        caption_justify="left",
    )
    table.add_column("of")
    table.add_column("squared error", justify="right")
    for name, value in errors.items():
        table.add_row(escape(name), _percent(value))
    return table


def _costs(result: Result) -> Table | None:
    seconds = _numbers(result.get("seconds"))
    sizes = _numbers(result.get("bytes"))
    if not seconds and not sizes:
        return None
    table = Table(title="costs: seconds of work, of all workers together", title_justify="left")
    table.add_column("stage or file")
    table.add_column("time", justify="right")
    table.add_column("size", justify="right")
    # what is called a total closes the table
    for name in sorted(dict.fromkeys([*seconds, *sizes]), key=lambda name: name == "total"):
        time = human_seconds(seconds[name]) if name in seconds else ""
        size = human_bytes(sizes[name]) if name in sizes else ""
        table.add_row(escape(name), time, size)
    return table


def _effects(result: Result) -> Table | None:
    effects = result.get("effects")
    if not _is_list(effects):
        return None
    table = Table(title="effects", title_justify="left")
    for heading in ("effect", "taken", "why"):
        table.add_column(heading)
    for item in effects:
        if isinstance(item, Mapping):
            name = escape(str(item.get("effect", item.get("name", "?"))))
            taken = "yes" if item.get("taken") else "no"
            table.add_row(name, taken, escape(str(item.get("reason", ""))))
    return table


def _is_list(value: Any) -> TypeGuard[Sequence[Any]]:
    return isinstance(value, Sequence) and not isinstance(value, str)


def _numbers(value: Any, prefix: str = "") -> dict[str, float]:
    found: dict[str, float] = {}
    if isinstance(value, Mapping):
        for name, inner in value.items():
            path = f"{prefix}.{name}" if prefix else str(name)
            number = _number(inner)
            found |= _numbers(inner, path) if number is None else {path: number}
    return found


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value)


def _percent(value: Any, *, starred: Any = False) -> str:
    """Write a ratio; a star says that it is below the noise of its measurement."""
    number = _number(value)
    return "" if number is None else f"{number:.3%}" + (" *" if starred else "")
