"""How far the trial of a lone bake goes: to centres that are enough, and while there is time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil
from typing import Any

from prtbake_workers.planning.bake_search import AIM, BOUNCE_SHARE
from prtbake_workers.planning.light_resolution import Candidate
from prtbake_workers.planning.rates import Rates

SURE = 0.7
"""Of what a bake may leave in directions and functions, that a trial of some vertices has to."""

LITTLE = 0.02
"""Of the squared error that is aimed at: without it the error is a hundredth less."""

TRIAL_SHARE = 0.1
"""Of the seconds that planning leaves: what trying centres may take, all of them together."""

LEAST_LEFT = 1e-5
"""Of transport, that is enough where no error is asked for."""


def is_enough(
    trial: Mapping[str, Any], tried: Sequence[Candidate], max_error: float | None
) -> bool:
    """Tell whether more centres than were tried are not needed, or would not help.

    They are not needed where, for some centres, directions and terms, what all lines are predicted
    to leave together is within what is aimed at.  They do not help where directions and functions
    leave next to nothing of it.

    Parameters
    ----------
    trial
        ``options``, ``left_out`` and ``bounced`` of the trial: see `BakeModel`.
    max_error
        Relative L2 error that is asked for, if one is.
    """
    least = min(one.error for one in tried)
    if max_error is None:
        return least <= LEAST_LEFT
    aim = (AIM * max_error) ** 2
    others = trial["left_out"] + (BOUNCE_SHARE * max_error**2 if trial["bounced"] else 0.0)
    return least <= LITTLE * aim or any(
        max(error / SURE + lost for error, lost in zip(one.errors, option["lost"], strict=True))
        + others
        <= aim
        for one in tried
        for option in trial["options"]
    )


@dataclass(frozen=True)
class TrialTime:
    """Seconds that are asked for, what they pay for, and what that is predicted to take.

    ``planned`` is the work of planning the scene for the trial.
    """

    max_seconds: float
    rates: Rates
    planned: Mapping[str, float]

    def holds(self, work: Mapping[str, float]) -> bool:
        """Tell whether the work of all that is tried takes no more than its share."""
        left = self.max_seconds - self._seconds(self.planned)
        return self._seconds(work) <= TRIAL_SHARE * left

    def least(self, work: Mapping[str, float]) -> int:
        """Give the least whole seconds that hold such work."""
        return ceil(self._seconds(self.planned) + self._seconds(work) / TRIAL_SHARE)

    def refusal(self, n_centres: int, work: Mapping[str, float]) -> str:
        """Say that not even the fewest centres can be tried in time."""
        return (
            f"{self.max_seconds:g} s are too few: trying {n_centres} centres may take a tenth of "
            "what planning leaves, which is predicted to need a time of "
            f"{self.least(work)} s at least"
        )

    def _seconds(self, work: Mapping[str, float]) -> float:
        return self.rates.stage_seconds("plan", work)
