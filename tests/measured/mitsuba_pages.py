"""A page of what baked results differ by from Mitsuba's pictures, as Markdown tables."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from measured.pages import hundredths, table

HEADER = "<!-- Written by `make mitsuba` (tests/measured/against_mitsuba.py): change that, not this page. -->"
MOST = 1e-3
"""relMSE that the path tracer and the baked result are held to."""

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
    baked: int
    terms: int
    seconds: float
    explained: Any
    fitted: Any


def page(title: str, about: str, tracer: Any, rows: Sequence[Measured]) -> str:
    """Return the whole page; ``tracer`` is the path tracer's `Agreement` at equal paths."""
    return (
        f"{HEADER}\n\n# Against Mitsuba: {title}\n\n{about}\n\n"
        f"## What holds\n\n{_statements(tracer, rows)}\n"
        "## The settings\n\n"
        "Seconds are of the bake, bounces included, in one thread, by the clock: beside other work on "
        "the machine they say little. Terms are those of the first part; baked were the vertices that "
        "the picture shows and those that send them light.\n\n"
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
        f"{_rel_mse(rows)}\n"
    )


def _statements(tracer: Any, rows: Sequence[Measured]) -> str:
    """Say which of the three statements hold, a line each."""
    best = min(rows, key=lambda row: row.explained.agreements[-1].rel_mse)
    closest = best.explained.agreements[-1].rel_mse
    n_bound = _count(rows, "is_bound")
    return "".join(
        f"- {said}: {'holds' if holds else 'does not hold'}.\n"
        for said, holds in (
            (
                f"The path tracer at equal paths, relMSE {tracer.rel_mse:.1e}, of it noise "
                f"{tracer.noise:.1e}, is at most 1e-3",
                tracer.rel_mse <= MOST,
            ),
            (
                f"The baked result, relMSE {closest:.1e} at *{best.label}*, the closest, is at most 1e-3",
                closest <= MOST,
            ),
            (
                "The lines of the budget bound what the baked result differs by, in "
                f"{n_bound} of {len(rows)} settings",
                n_bound == len(rows),
            ),
        )
    )


def _count(rows: Sequence[Measured], name: str) -> int:
    return sum(getattr(row.explained, name) for row in rows)


def _settings(rows: Sequence[Measured]) -> str:
    return table(
        [
            "setting", "centres", "directions", "terms", "vertices", "baked", "bounce rays", "seconds",
        ],
        (
            [
                row.label, f"{row.n_centres:,}", f"{row.n_directions:,}", str(row.terms),
                f"{row.vertices:,}", f"{row.baked:,}", str(row.bounce_rays), f"{row.seconds:.1f}",
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
