"""Predicted beside measured: the rows of `cost_model`, their quantiles and the page of them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

SECONDS, STAGES, BYTES, MEMORY = "seconds", "stage seconds", "bytes", "peak memory"
WITHIN = {SECONDS: 1.3, BYTES: 1.15, MEMORY: 1.15}
"""Factor that a prediction must lie within for most jobs."""

MOST = 0.9
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
UNITS = {SECONDS: "s", STAGES: "s", BYTES: "B", MEMORY: "B"}


@dataclass(frozen=True)
class Row:
    """A figure of one job: what it is (``of`` names the file or the stage), predicted, measured."""

    job: int
    scene: str
    what: str
    of: str
    predicted: float
    measured: float

    @property
    def factor(self) -> float:
        """Predicted over measured."""
        return self.predicted / self.measured


def off_by(rows: Iterable[Row]) -> dict[int, float]:
    """Give each job the factor of its worst row, 1 or more whichever way it is off."""
    worst: dict[int, float] = {}
    for row in rows:
        factor = max(row.factor, 1.0 / row.factor)
        worst[row.job] = max(worst.get(row.job, 1.0), factor)
    return worst


def share_within(rows: Iterable[Row], factor: float) -> float:
    """Give the share of jobs all of whose rows are predicted within a factor."""
    worst = list(off_by(rows).values())
    return sum(own <= factor for own in worst) / len(worst)


def statements(rows: Sequence[Row]) -> list[tuple[str, bool]]:
    """Say what must hold, and whether it does."""
    found = []
    for what, factor in WITHIN.items():
        share = share_within([row for row in rows if row.what == what], factor)
        found.append((
            f"{what} within a factor {factor:g} for {share:.0%} of the jobs, where {MOST:.0%} are "
            "asked for",
            share >= MOST,
        ))  # fmt: skip
    return found


def page(rows: Sequence[Row], *, about: str, machine: str) -> str:
    """Write the page."""
    jobs = len({row.job for row in rows})
    lines = ["# Measured, the cost model", "", about, "", f"{machine} {jobs} jobs.", ""]
    lines += [f"- {'holds' if holds else 'FAILS'}: {text}" for text, holds in statements(rows)]
    heads = " | ".join(f"{quantile:.0%}" for quantile in QUANTILES)
    lines += [
        "",
        "Predicted over measured, by quantiles over the jobs:",
        "",
        f"| what | of | jobs | {heads} |",
        f"|---|---|---:|{'---:|' * len(QUANTILES)}",
    ]
    for what in UNITS:
        for of in sorted({row.of for row in rows if row.what == what}):
            factors = [row.factor for row in rows if (row.what, row.of) == (what, of)]
            cells = " | ".join(f"{value:.2f}" for value in np.quantile(factors, QUANTILES))
            lines.append(f"| {what} | {of} | {len(factors)} | {cells} |")
    return "\n".join(lines) + "\n"
