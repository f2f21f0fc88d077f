"""The table of effects: rows, the file that keeps them, what they prove, and the page."""

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from measured.pages import percent, table

HEADER = "<!-- Written by `make effects` (tests/measured): change that, not this page. -->"
EVERYTHING = "everything"
DIRECT = ("self_shadowing", "receiver_shadows")
"""Effects of direct light alone."""

LEAST_SAVED = 0.5
"""Of the bake time with everything on, on the median scene."""
LEAST_NEEDING = 9
"""Scenes that need an effect beyond direct shadows."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One scene, and one effect of it or `EVERYTHING`; None where there is nothing to measure.

    Attributes
    ----------
    decided
        ``taken`` or ``left`` by planning, empty for everything.
    predicted
        By planning: the error of deciding the other way.
    changes
        Measured: the error of a bake without the effect, of one with it, all else as decided.
    tolerance
        What that error is held against.
    seconds_decided, seconds_on, seconds_off
        CPU time of the bake's tasks.
    error_decided, error_on, error_off
        Against the bake with everything forced on.
    """

    scene: str
    effect: str
    vertices: int
    decided: str = ""
    predicted: float | None = None
    changes: float | None = None
    tolerance: float | None = None
    seconds_decided: float = 0.0
    seconds_on: float | None = None
    seconds_off: float | None = None
    error_decided: float = 0.0
    error_on: float | None = None
    error_off: float | None = None

    @property
    def is_effect(self) -> bool:
        """Whether this is one effect, not all together."""
        return self.effect != EVERYTHING

    @property
    def matters(self) -> bool:
        """Whether leaving the effect out costs more than the tolerance."""
        return (
            self.changes is not None
            and self.tolerance is not None
            and self.changes > self.tolerance
        )

    @property
    def verdict(self) -> str:
        """Say what the decision was worth."""
        if self.changes is None:
            return "nothing to take" if self.decided == "left" else "cannot be left"
        if self.decided == "left":
            return "**needed, and left**" if self.matters else "rightly left"
        return "needed" if self.matters else "taken, little"


def merged(kept: Sequence[Row], new: Sequence[Row], order: Sequence[str]) -> list[Row]:
    """Put new rows in the place of those of their scenes, in the order of the scenes."""
    fresh = {row.scene for row in new}
    rows = [*(row for row in kept if row.scene not in fresh), *new]
    return sorted(
        (row for row in rows if row.scene in order), key=lambda row: order.index(row.scene)
    )


@dataclass(frozen=True)
class Statement:
    """Something the table is to prove, whether it does, and by what."""

    text: str
    holds: bool
    evidence: str


def statements(rows: Sequence[Row], scenes: Sequence[str]) -> list[Statement]:
    """Judge the rows: all scenes are there, nothing needed is left, and planning saves time."""
    missing = [name for name in scenes if all(row.scene != name for row in rows)]
    effects = [row for row in rows if row.is_effect]
    left = [row for row in effects if row.decided == "left" and row.changes is not None]
    worst = max(left, key=lambda row: (row.changes or 0.0) / (row.tolerance or 1.0), default=None)
    saved = {row.scene: saving(row) for row in rows if not row.is_effect}
    median = statistics.median(saved.values()) if saved else 0.0
    wrong = [row for row in effects if row.decided == "left" and row.matters]
    needing = {row.scene for row in effects if row.matters and row.effect not in DIRECT}
    return [
        Statement(
            f"all {len(scenes)} scenes are measured",
            not missing,
            f"missing: {', '.join(missing)}" if missing else "none is missing",
        ),
        Statement(
            "a skipped effect costs less than the tolerance in every row",
            worst is None or not worst.matters,
            "none was skipped that could be taken"
            if worst is None
            else f"{len(left)} are skipped; the dearest, {worst.effect} of {worst.scene}, costs "
            f"{percent(worst.changes)} where {percent(worst.tolerance)} is allowed",
        ),
        Statement(
            "against everything forced on, planning saves at least "
            f"{100 * LEAST_SAVED:.0f} % of the bake time on the median scene",
            median >= LEAST_SAVED,
            f"{100 * median:.0f} % on the median scene, "
            + (
                f"{100 * min(saved.values()):.0f} to {100 * max(saved.values()):.0f} % over all"
                if saved
                else "of none"
            ),
        ),
        Statement(
            f"a needed effect is skipped in none, and at least {LEAST_NEEDING} scenes need one "
            "beyond direct shadows",
            not wrong and len(needing) >= LEAST_NEEDING,
            f"{len(wrong)} are skipped, {len(needing)} scenes need one beyond direct shadows",
        ),
    ]


def saving(row: Row) -> float:
    """Return the share of the time with everything on that planning saves."""
    return 1.0 - row.seconds_decided / row.seconds_on if row.seconds_on else 0.0


def page(
    rows: Sequence[Row], titles: Mapping[str, str], *, settings: str, machine: str, about: str
) -> str:
    """Return the page."""
    proved = table(
        ["", "statement", "measured"],
        (
            ["holds" if one.holds else "**FAILS**", one.text, one.evidence]
            for one in statements(rows, list(titles))
        ),
    )
    return (
        "\n\n".join(
            [
                f"{HEADER}\n\n# Effects, scene by scene",
                about,
                f"Settings: {settings}. {machine}",
                f"## What the tables prove\n\n{proved}",
                f"## Everything\n\n{_scenes(rows, titles)}",
                f"## Effect by effect\n\n{_effects(rows, titles)}",
            ]
        )
        + "\n"
    )


def _scenes(rows: Sequence[Row], titles: Mapping[str, str]) -> str:
    whole = [row for row in rows if not row.is_effect]
    taken: dict[str, list[str]] = {}
    for row in rows:
        if row.decided == "taken" and row.effect not in DIRECT:
            taken.setdefault(row.scene, []).append(row.effect.replace("_", " "))
    return table(
        ["scene", "vertices", "taken beyond direct shadows", "seconds decided", "all on", "all off",
         "saved", "error decided", "error all off"],
        (
            [
                titles[row.scene], f"{row.vertices:,}", ", ".join(taken.get(row.scene, ["none"])),
                f"{row.seconds_decided:.1f}", _seconds(row.seconds_on), _seconds(row.seconds_off),
                f"{100 * saving(row):.0f} %", percent(row.error_decided), percent(row.error_off),
            ]
            for row in whole
        ),
    )  # fmt: skip


def _effects(rows: Sequence[Row], titles: Mapping[str, str]) -> str:
    return table(
        ["scene", "effect", "decided", "verdict", "predicted", "measured", "tolerance",
         "seconds decided", "on", "off", "error decided", "on", "off"],
        (
            [
                titles[row.scene], row.effect.replace("_", " "), row.decided, row.verdict,
                percent(row.predicted), percent(row.changes), percent(row.tolerance),
                f"{row.seconds_decided:.1f}", _seconds(row.seconds_on), _seconds(row.seconds_off),
                percent(row.error_decided), percent(row.error_on), percent(row.error_off),
            ]
            for row in rows
            if row.is_effect
        ),
    )  # fmt: skip


def _seconds(count: float | None) -> str:
    return "" if count is None else f"{count:.1f}"
