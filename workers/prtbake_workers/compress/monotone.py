"""The rule that an objective may not rise, kept while it is being reduced.

Every step of the clusterings and of the alternating fits is a minimisation with the rest held
fixed, so the squared error can only fall.  Where it rises by more than rounding, a step is wrong.
"""

import math
import time

from prtbake_storage.errors import PrtError
from prtbake_workers.deadline import time_for

# What float32 products cost, as a share of the input's squared norm: one rounding of a stored
# factor is 6e-8, and differences of energies inherit it.
ALLOWED_RISE = 1e-7

# What an objective that was followed may lack of the measured one, as a share of the same: a row
# that moves adds and takes away what float32 gives to 1e-7 of its squared norm, and may move some
# hundred times.  2.4e-8 was the most that 240 fits lacked.
FOLLOWED_SHORT = 1e-5


class ObjectiveRose(PrtError):
    """A step that must not raise the squared error did: a fault of the program, not of the data."""

    code = "objective-rose"


class ObjectiveTrace:
    """The squared error after each step, checked against the one before.

    Parameters
    ----------
    squared_norm
        Squared norm of the input in the objective's own units, >= 0.
    name
        What is being minimised, for the message.
    may_rise
        Whether something beside the squared error is traded for it, so that a rise is no fault.
    """

    def __init__(self, squared_norm: float, name: str, *, may_rise: bool = False) -> None:
        self.squared_norm = squared_norm
        self.name = name
        self.may_rise = may_rise
        self.values: list[float] = []
        self._longest, self._since = 0.0, time.monotonic()

    def append(self, value: float) -> None:
        """Add the objective after a step.

        Raises
        ------
        ObjectiveRose
            When ``value`` is above the one before by more than ``ALLOWED_RISE`` of the squared
            norm, or is not a number.
        """
        if not math.isfinite(value):
            raise ObjectiveRose(f"{self.name}: objective {value} after {len(self.values)} steps")
        if self.values and not self.may_rise:
            rise = value - self.values[-1]
            if rise > ALLOWED_RISE * self.squared_norm:
                raise ObjectiveRose(
                    f"{self.name}: step {len(self.values)} raised the squared error from "
                    f"{self.values[-1]:.9g} to {value:.9g}, "
                    f"{rise / self.squared_norm:.2e} of the input's squared norm"
                )
        self.values.append(value)
        now = time.monotonic()
        self._longest, self._since = max(self._longest, now - self._since), now

    def measured(self, value: float) -> None:
        """Put the last objective right, where it was followed rather than measured.

        Unless it may rise, none before it was lower: those that were followed below it are raised.

        Raises
        ------
        ObjectiveRose
            When ``value`` is above the last one by more than ``FOLLOWED_SHORT`` of the squared
            norm, or is not a number.
        """
        if not math.isfinite(value):
            raise ObjectiveRose(f"{self.name}: objective {value} was measured")
        if self.values:
            short = value - self.values[-1]
            if short > FOLLOWED_SHORT * self.squared_norm:
                raise ObjectiveRose(
                    f"{self.name}: a squared error of {value:.9g} was measured and followed as "
                    f"{self.values[-1]:.9g}, {short / self.squared_norm:.2e} of the input's "
                    "squared norm less"
                )
            self.values[-1] = value
        if not self.may_rise:
            self.values = [max(one, value) for one in self.values]

    def has_time(self) -> bool:
        """Whether a step as long as the longest so far ends before the deadline, if any."""
        return time_for(self._longest)

    @property
    def ratio(self) -> float:
        """The last objective over the squared norm; 0 for an input of zeros."""
        if not self.values or self.squared_norm == 0.0:
            return 0.0
        return self.values[-1] / self.squared_norm

    def has_converged(self, tolerance: float) -> bool:
        """Whether the last step won less than ``tolerance`` of the objective before it.

        Where that may rise, whether it changed by less.
        """
        if not self.values:
            return False
        if self.values[-1] <= 0.0:
            return True
        if len(self.values) < 2:
            return False
        won = self.values[-2] - self.values[-1]
        return (abs(won) if self.may_rise else won) < tolerance * self.values[-2]
