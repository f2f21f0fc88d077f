"""How far the trial of a lone bake goes: when the centres that were tried are enough."""

from collections.abc import Mapping, Sequence
from typing import Any

from prtbake_workers.planning.bake_search import AIM, BOUNCE_SHARE
from prtbake_workers.planning.light_resolution import Candidate

SURE = 0.7
"""Of what a bake may leave in directions and functions, that a trial of some vertices has to."""

LITTLE = 0.02
"""Of the squared error that is aimed at: without it the error is a hundredth less."""

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
