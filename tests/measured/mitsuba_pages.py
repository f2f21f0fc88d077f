"""A page of what baked results differ by from Mitsuba's pictures, as Markdown tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from measured.pages import hundredths, table

HEADER = "<!-- Written by `make mitsuba` (tests/measured/against_mitsuba.py): change that, not this page. -->"
MOST = 1e-3
"""What the path tracer itself is held to."""

LINES = {
    "reference": "our reference",
    "K terms": "K terms",
    "BRDF tables": "tables",
    "vertex interpolation": "vertices",
    "visibility sampling": "visibility",
    "SRBF basis": "SRBF basis",
    "bounces and 16-bit transfer": "bounces, 16 bits",
    "light fit": "light fit",
}
"""Line of the budget and the head of its column."""


@dataclass(frozen=True)
class Measured:
    """One setting: what it was, and what explains its picture, without and with the fitted light."""

    label: str
    n_centres: int
    n_directions: int
    bounce_rays: int
    vertices: int
    terms: int
    seconds: float
    explained: Any
    fitted: Any


def page(title: str, about: str, rows: Sequence[Measured]) -> str:
    """Return the whole page."""
    best = min(rows, key=lambda row: row.explained.agreements[-1].rel_mse)
    closest = best.explained.agreements[-1].rel_mse
    verdict = "at most" if closest <= MOST else "above"
    return (
        f"{HEADER}\n\n# Against Mitsuba: {title}\n\n{about}\n\n"
        "## The settings\n\n"
        "Seconds are of the direct bake in one thread, by the clock: beside other work on the machine "
        "they say little. Terms are those of the first part.\n\n"
        f"{_settings(rows)}\n\n"
        "## What explains the difference\n\n"
        "Relative L2 over the pixels, of Mitsuba's picture. Each line is one step further from it; "
        "*measured* is the baked result, before compression and lit by the projected environment, "
        "against Mitsuba. All that bounces lack stands in their own line. A star says that a line is "
        f"below its own noise.\n\n{_budget(rows)}\n\n"
        f"The sum bounds what was measured, within the noise of that, in {_count(rows, 'is_bound')} "
        f"of {len(rows)} settings; what was measured is at least a third of the sum in "
        f"{_count(rows, 'is_tight')} of {len(rows)}.\n\n"
        "## relMSE\n\n"
        "Against the same picture of Mitsuba's, step by step; the noise is what of the baked "
        "result's is to be expected of Mitsuba's paths alone.\n\n"
        f"{_rel_mse(rows)}\n\n"
        f"Closest is *{best.label}*: {closest:.1e}, {verdict} 1e-3.\n"
    )


def _count(rows: Sequence[Measured], name: str) -> int:
    return sum(getattr(row.explained, name) for row in rows)


def _settings(rows: Sequence[Measured]) -> str:
    return table(
        ["setting", "centres", "directions", "terms", "vertices", "bounce rays", "seconds"],
        (
            [
                row.label, f"{row.n_centres:,}", f"{row.n_directions:,}", str(row.terms),
                f"{row.vertices:,}", str(row.bounce_rays), f"{row.seconds:.1f}",
            ]
            for row in rows
        ),
    )  # fmt: skip


def _budget(rows: Sequence[Measured]) -> str:
    names = [LINES[line.name] for line in rows[0].explained.budget.lines]
    return table(
        ["setting", *(f"+ {name}" for name in names), "sum", "measured", "its noise"],
        (
            [
                row.label,
                *(
                    hundredths(line.error) + (" \\*" if line.below_noise else "")
                    for line in row.explained.budget.lines
                ),
                hundredths(row.explained.budget.sum_of_lines),
                f"**{hundredths(row.explained.budget.total)}**",
                hundredths(row.explained.slack),
            ]
            for row in rows
        ),
    )


def _rel_mse(rows: Sequence[Measured]) -> str:
    names = [LINES[line.name] for line in rows[0].explained.budget.lines]
    return table(
        ["setting", *names[:-1], "**baked result**", "its noise", "with the fitted light"],
        (
            [
                row.label,
                *(f"{one.rel_mse:.1e}" for one in row.explained.agreements[:-1]),
                f"**{row.explained.agreements[-1].rel_mse:.1e}**",
                f"{row.explained.agreements[-1].noise:.1e}",
                f"{row.fitted.agreements[-1].rel_mse:.1e}",
            ]
            for row in rows
        ),
    )
