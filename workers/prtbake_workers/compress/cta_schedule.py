"""Which step of a clustered tensor approximation comes next.

Decided by counts and objectives alone, so that whoever has the steps made elsewhere takes the same
ones as whoever makes them.
"""

from collections.abc import Iterable
from enum import Enum
from math import fsum

from prtbake_workers.compress.monotone import ObjectiveTrace

APPROXIMATION_ITERATIONS = 3
CONVERGED = 1e-3


class Step(Enum):
    """What is to be made of all clusters; the value is a word for people."""

    MODEL = "clustering"
    CLASSIFY = "classification"
    VIEW = "view basis"
    FIT = "approximation"
    END = "end"


class Schedule:
    """The steps of one fit, from the first model step on.

    Model steps and classifications alternate until nobody moves, a model step wins too little, or
    there have been enough; then view bases and model steps do.  Before a deadline (`ends_by`) no
    step begins that would end after it.

    Parameters
    ----------
    squared_norm
        Of the tensor, weighted.
    max_iterations
        Most model steps of the clustering phase.
    tolerance
        Share of the error that an iteration must win for another to follow.
    """

    def __init__(
        self, squared_norm: float, max_iterations: int, tolerance: float = CONVERGED
    ) -> None:
        self.trace = ObjectiveTrace(squared_norm, "CTA")
        self.max_iterations, self.tolerance = max_iterations, tolerance
        self.step = Step.MODEL
        self._models = self._approximations = 0

    def modelled(self, objectives: Iterable[float]) -> None:
        """Go on after a model step that left these weighted squared errors of the clusters.

        Raises
        ------
        ObjectiveRose
            Their sum is above the one before.
        """
        self.trace.append(fsum(objectives))
        converged = self.trace.has_converged(self.tolerance)
        if self.step is Step.MODEL:
            self._models += 1
            ends = converged or self._models == self.max_iterations
            self.step = Step.VIEW if ends else Step.CLASSIFY
        else:
            self._approximations += 1
            ends = converged or self._approximations == APPROXIMATION_ITERATIONS
            self.step = Step.END if ends else Step.VIEW
        if self.step is not Step.END and not self.trace.has_time():
            self.step = Step.END

    def moved(self, n_moved: int) -> None:
        """Go on after a classification that moved so many vertices."""
        self.step = Step.MODEL if n_moved else Step.VIEW
        if not n_moved and not self.trace.has_time():
            self.step = Step.END

    def seen(self) -> None:
        """Go on after a new view basis."""
        self.step = Step.FIT

    @property
    def fraction(self) -> float:
        """How much of the most steps is done."""
        done = self._models
        if self._approximations:
            done = self.max_iterations + self._approximations
        return (done + 1) / (self.max_iterations + APPROXIMATION_ITERATIONS + 1)
