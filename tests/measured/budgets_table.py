"""Budgets that were asked for beside what came: the rows of `budgets`, what holds, the page."""

from collections.abc import Sequence
from dataclasses import dataclass

from measured.pages import table

HEADER = "<!-- Written by `make budgets` (tests/measured): change that, not this page. -->"
ERROR, TIME = "error", "time"
NEAR = 0.6
LEAST_NEAR = 0.75
"""Share of the errors asked for that are to come to `NEAR` of them at least."""

OVERRUN = 1.1
MOST_REFUSED = 0.1
"""Share of the times asked for that may be too short for the least asset."""

REFUSED = "refused"


@dataclass(frozen=True)
class Row:
    """One job: what was asked for, and what came.

    Attributes
    ----------
    scene, what, asked
        Name of the scene; `ERROR` or `TIME`; relative, or seconds.
    error
        At held-out views, of a job that was asked for an error; None if it was refused.
    n_bytes, seconds
        Of the asset; of the job, by the clock.
    said
        The reason of a refusal, or what was delivered.
    """

    scene: str
    what: str
    asked: float
    error: float | None
    n_bytes: int
    seconds: float
    said: str = ""

    @property
    def key(self) -> tuple[str, str, float]:
        """What tells this job from the others."""
        return self.scene, self.what, self.asked

    @property
    def share(self) -> float | None:
        """Of the error that was asked for."""
        return None if self.error is None else self.error / self.asked


def of_kind(rows: Sequence[Row], what: str) -> list[Row]:
    """Take the jobs that were asked for an error, or for a time."""
    return [row for row in rows if row.what == what]


def statements(rows: Sequence[Row]) -> list[tuple[bool, str]]:
    """Say whether each promise holds, and by what figures."""
    met, kept = of_kind(rows, ERROR), of_kind(rows, TIME)
    shares = [row.share for row in met if row.share is not None]
    above = sum(share > 1.0 for share in shares)
    near = sum(NEAR <= share <= 1.0 for share in shares)
    late = sum(row.seconds > OVERRUN * row.asked for row in kept)
    refused = sum(row.said == REFUSED for row in kept)
    return [
        (above == 0, f"no asset errs by more than what was asked for: {above} of {len(met)} do"),
        (
            near >= LEAST_NEAR * len(met),
            f"three in four err by at least {NEAR:g} of it: {near} of {len(met)} do, "
            f"{len(met) - len(shares)} were refused",
        ),
        (
            late == 0 and refused <= MOST_REFUSED * len(kept),
            f"no time is overrun by more than a tenth: {late} of {len(kept)} are, "
            f"{refused} were refused",
        ),
    ]


def page(rows: Sequence[Row], *, about: str, machine: str) -> str:
    """Return the whole page."""
    errors = [
        (
            row.scene, f"{100 * row.asked:g} %",
            REFUSED if row.error is None else f"{100 * row.error:.3g} %",
            "–" if row.share is None else f"{row.share:.2f}",
            f"{row.n_bytes / 1000:,.0f} kB", f"{row.seconds:.0f}",
        )
        for row in of_kind(rows, ERROR)
    ]  # fmt: skip
    times = [
        (row.scene, f"{row.asked:g}", f"{row.seconds:.1f}", row.said) for row in of_kind(rows, TIME)
    ]
    said = "".join(
        f"- {text}: {'holds' if holds else 'does not hold'}.\n" for holds, text in statements(rows)
    )
    head = ("scene", "asked", "error", "share", "bytes", "seconds")
    return (
        f"{HEADER}\n\n# Budgets that were asked for\n\n{about}\n\n{machine}\n\n"
        f"## What holds\n\n{said}\n## Errors\n\n{table(head, errors)}\n"
        f"\n## Times\n\n{table(('scene', 'seconds asked', 'taken', 'made'), times)}\n"
    )
