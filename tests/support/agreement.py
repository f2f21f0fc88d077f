"""How far pictures are from another renderer's, and whether a chain of pictures explains it."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from prtbake_workers.render.metrics import REL_MSE_FLOOR, rel_mse
from prtbake_workers.validation.budget import Budget, ChainPicture, make_budget


@dataclass(frozen=True)
class Picture:
    """A mean of independent parts, (parts, height, width, 3); a single part has no noise."""

    parts: Any

    @cached_property
    def mean(self):
        return self.parts.mean(axis=0)

    @cached_property
    def variance(self):
        """Of the mean."""
        n = len(self.parts)
        return self.parts.var(axis=0, ddof=1) / n if n > 1 else np.zeros(self.parts.shape[1:])


@dataclass(frozen=True)
class Agreement:
    """Of one picture with another, over the pixels in which either shows anything.

    ``rel_mse`` is the project's metric, ``noise`` the part of it to be expected of two pictures with
    these variances, ``floor`` what two such pictures of the other renderer would differ by, ``ratio``
    that of the mean radiances and ``ratio_error`` its standard error.
    """

    rel_mse: float
    noise: float
    floor: float
    ratio: float
    ratio_error: float

    @classmethod
    def between(cls, ours, theirs):
        mask = ours.mean.any(axis=2) | theirs.mean.any(axis=2)
        reference = theirs.mean[mask]
        scale = reference**2 + REL_MSE_FLOOR * (reference**2).mean()
        variance = ours.variance + theirs.variance
        return cls(
            rel_mse(ours.mean.astype(np.float32), theirs.mean.astype(np.float32), mask),
            float((variance[mask] / scale).mean()),
            float((2.0 * theirs.variance[mask] / scale).mean()),
            float(ours.mean.sum() / theirs.mean.sum()),
            # the channels of one path move together
            float(np.sqrt(3.0 * variance.sum()) / theirs.mean.sum()),
        )


@dataclass(frozen=True)
class Explained:
    """What makes a chain's last picture differ from theirs.

    ``budget`` begins with their picture, so that its first line is the brute-force reference
    itself and its total the difference to be explained; ``own`` begins with that reference: it is
    the budget that validation draws up, without them.  ``agreements`` are of every picture of the
    chain with theirs.
    """

    budget: Budget
    own: Budget
    agreements: tuple[Agreement, ...]

    @classmethod
    def of(cls, theirs, chain):
        n_parts, *size = theirs.parts.shape
        first = ChainPicture("theirs", theirs.parts.reshape(n_parts, -1, 3))
        return cls(
            make_budget([first, *chain]),
            make_budget(chain),
            tuple(
                Agreement.between(Picture(one.passes.reshape(-1, *size)), theirs) for one in chain
            ),
        )

    @property
    def slack(self):
        """Noise of the difference, which was subtracted: it may have moved the bounds by as much."""
        return self.budget.total_noise

    def __str__(self):
        rows = [
            f"{line.name} {line.error:.2%} (noise {line.noise:.2%}), relMSE {agreement.rel_mse:.2e}"
            for line, agreement in zip(self.budget.lines, self.agreements, strict=True)
        ]
        sums = f"sum {self.budget.sum_of_lines:.2%}, without the reference's {self.own.sum_of_lines:.2%}"
        return "; ".join(
            [*rows, sums, f"measured {self.budget.total:.2%}", f"noise {self.slack:.2%}"]
        )

    @property
    def is_bound(self):
        """Whether the sum of the lines is at least the difference."""
        return self.budget.total <= self.budget.sum_of_lines + self.slack

    @property
    def is_tight(self):
        """Whether the difference is at least a third of the sum."""
        return self.budget.total + self.slack >= self.budget.sum_of_lines / 3.0
