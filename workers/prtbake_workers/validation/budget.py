"""The error budget: what each step from the reference to the asset adds to a picture.

A line is the L2 difference of two neighbouring pictures of the chain over the pixels that show the
surface, relative to the reference's own L2 norm.  Where a picture comes from Monte Carlo passes,
the squared difference of the means is too large by the variance of the mean difference; that
variance is estimated from the passes, subtracted, and stated.

Where the reference is black, or its noise hides it, lines are relative to the brightest picture of
the chain instead, and the budget says so.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from prtbake_workers.arrays import F64, Float64


@dataclass(frozen=True)
class ChainPicture:
    """One picture of the chain: its values in every pass (one pass where it is deterministic)."""

    name: str
    """What this picture adds over the one before it."""
    passes: Float64[F64, "passes hits 3"]

    @property
    def mean(self) -> Float64[F64, "hits 3"]:
        """The picture."""
        return np.asarray(self.passes.mean(axis=0))


@dataclass(frozen=True)
class BudgetLine:
    """One step: its relative L2 error, the noise that was subtracted, whether noise hides it."""

    name: str
    error: float
    noise: float
    below_noise: bool


@dataclass(frozen=True)
class Budget:
    """The lines, their sum and the measured total of one picture (or of several, pooled)."""

    lines: tuple[BudgetLine, ...]
    total: float
    total_noise: float
    total_below_noise: bool
    reference_noise: float
    """Relative standard error of the reference picture itself."""
    squared_norm: float
    """What the squares of the errors are relative to: the squared norm of the reference."""
    black_reference: bool = False
    """The reference is black or lost in its noise: ``squared_norm`` is the brightest picture's."""

    @property
    def sum_of_lines(self) -> float:
        """What the total may at most be, by the triangle inequality."""
        return sum(line.error for line in self.lines)

    def to_dict(self) -> dict[str, Any]:
        """Give the budget as JSON."""
        return asdict(self) | {"sum_of_lines": self.sum_of_lines}


def squared_difference(a: ChainPicture, b: ChainPicture) -> tuple[float, float]:
    """Return the squared norm of the mean difference, and the variance that it holds.

    Two sampled pictures are differenced pass by pass, so that what they share cancels.
    """
    if min(len(a.passes), len(b.passes)) > 1 and len(a.passes) != len(b.passes):
        raise ValueError(f"{a.name} has {len(a.passes)} passes, {b.name} {len(b.passes)}")
    difference = b.passes - a.passes
    squared = float((difference.mean(axis=0) ** 2).sum())
    n = difference.shape[0]
    variance = float(difference.var(axis=0, ddof=1).sum()) / n if n > 1 else 0.0
    return squared, variance


def make_budget(chain: Sequence[ChainPicture]) -> Budget:
    """Draw up the budget of a chain that begins with the reference and ends with the asset."""
    reference = chain[0]
    n = len(reference.passes)
    noise = float(reference.passes.var(axis=0, ddof=1).sum()) / n if n > 1 else 0.0
    squared = float((reference.mean**2).sum()) - noise
    black = squared <= 0.0
    if black:
        if not any(picture.passes.any() for picture in chain):
            dark = tuple(BudgetLine(picture.name, 0.0, 0.0, False) for picture in chain[1:])
            return Budget(dark, 0.0, 0.0, False, 0.0, 0.0)
        squared = max(float((p.passes**2).sum()) / len(p.passes) for p in chain)
    lines = []
    for before, after in pairwise(chain):
        value, variance = squared_difference(before, after)
        lines.append(_line(after.name, value, variance, squared))
    value, variance = squared_difference(reference, chain[-1])
    total = _line("total", value, variance, squared)
    return Budget(
        lines=tuple(lines),
        total=total.error,
        total_noise=total.noise,
        total_below_noise=total.below_noise,
        reference_noise=float(np.sqrt(noise / squared)),
        squared_norm=squared,
        black_reference=black,
    )


def pool_budgets(budgets: Sequence[Budget]) -> Budget:
    """Pool the budgets of several pictures: every norm is taken over all of their pixels.

    A pooled error is below its noise where the pooled square is less than twice its variance, as
    for one picture; a picture that shows nothing counts for nothing.  One with a black reference
    adds its differences and no norm, unless all are such.
    """
    weights = [budget.squared_norm for budget in budgets]
    if not any(weights):
        return budgets[0]
    squared = sum(budget.squared_norm for budget in budgets if not budget.black_reference)
    black = squared == 0.0
    if black:
        squared = sum(weights)

    def pooled(values: list[float]) -> float:
        return float(np.sqrt(np.dot(weights, np.square(values)) / squared))

    def line_of(name: str, errors: list[float], noises: list[float]) -> BudgetLine:
        error, noise = pooled(errors), pooled(noises)
        return BudgetLine(name, error, noise, below_noise=noise > 0.0 and error < noise)

    lines = tuple(
        line_of(
            line.name,
            [budget.lines[i].error for budget in budgets],
            [budget.lines[i].noise for budget in budgets],
        )
        for i, line in enumerate(budgets[0].lines)
    )
    total = line_of(
        "total", [budget.total for budget in budgets], [budget.total_noise for budget in budgets]
    )
    return Budget(
        lines=lines,
        total=total.error,
        total_noise=total.noise,
        total_below_noise=total.below_noise,
        reference_noise=pooled([budget.reference_noise for budget in budgets]),
        squared_norm=squared,
        black_reference=black,
    )


def _line(name: str, value: float, variance: float, squared: float) -> BudgetLine:
    return BudgetLine(
        name=name,
        error=float(np.sqrt(max(value - variance, 0.0) / squared)),
        noise=float(np.sqrt(variance / squared)),
        below_noise=value < 2.0 * variance,
    )
