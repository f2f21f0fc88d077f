"""The report as one HTML page with its pictures inside: nothing to fetch, nothing to run."""

import base64
import json
from collections.abc import Mapping
from typing import Any

import jinja2

from prtbake_workers.validation.chain import MEANINGS

ENVIRONMENT = jinja2.Environment(
    loader=jinja2.PackageLoader("prtbake_workers.report", "templates"),
    autoescape=True,
    undefined=jinja2.StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def percent(value: int | float | None) -> str:
    """Write a ratio; a dash where there is none."""
    if value is None:
        return "–"
    return f"{100 * value:.3g} %"


def size(value: int | float) -> str:
    """Write a number of bytes."""
    for unit in ("B", "kB", "MB"):
        if abs(value) < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"


def seconds(value: int | float) -> str:
    """Write a duration."""
    return f"{value:.3g} s" if value < 120 else f"{value / 60:.1f} min"


ENVIRONMENT.filters |= {"percent": percent, "size": size, "seconds": seconds, "json": json.dumps}


def report_page(
    report: Mapping[str, Any], pictures: Mapping[str, bytes], plot: bytes | None = None
) -> str:
    """Render a report (see :mod:`prtbake_workers.report.account`) and its PNG pictures.

    ``plot`` shows the report's frontier.
    """
    return ENVIRONMENT.get_template("report.html").render(
        report=report,
        pictures={name: _embedded(data) for name, data in pictures.items()},
        plot=None if plot is None else _embedded(plot),
        meanings=MEANINGS,
    )


def _embedded(picture: bytes) -> str:
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")
