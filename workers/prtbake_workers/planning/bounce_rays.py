"""How many rays a vertex look for bounced light, from what one ray alone would miss."""

from collections.abc import Sequence
from math import ceil, sqrt

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.planning.decision import Decision
from prtbake_workers.transport.ray_pilot import FALL, FEWEST

NOISE_SHARE = 0.5
"""Of the tolerance, that the rays' noise may take."""

LATER_SHARE = 0.25
"""Of the noise of the first bounce, that the second may add."""


def noise_allowed(decided: Decision, bake: BakeSettings) -> float:
    """Give the squared-error ratio that the rays' noise may reach; 0 where all rays are taken.

    Forcing interreflection takes them all: light below the tolerance would drown in noise that is
    measured by it.
    """
    return 0.0 if decided.forced else NOISE_SHARE * bake.bounce_tolerance


def pilot_tolerance(decided: Decision, bake: BakeSettings) -> float:
    """Give the squared-error ratio that one bounce may err by, for all to keep `noise_allowed`.

    They share their rays, so their errors add up as amplitudes do: a geometric series.
    """
    share = min(decided.evidence["first_bounce_share"], 1.0)
    return noise_allowed(decided, bake) * (1.0 - sqrt(share)) ** 2


def bounce_rays(decided: Decision, bake: BakeSettings) -> tuple[int, ...]:
    """Choose the rays of a vertex of each part: ``bake.bounce_rays``, or fewer if noise allows it.

    Parameters
    ----------
    decided
        On interreflection; ``variances`` of its evidence are the squared errors of one ray a vertex
        over the squared norm of a part's direct transfer.
    bake
        Settings, with the tolerance.
    """
    allowed = noise_allowed(decided, bake)
    variances = decided.evidence["variances"]
    if allowed == 0.0:
        return (bake.bounce_rays,) * len(variances)
    needed = [ceil((variance / allowed) ** (1.0 / FALL)) for variance in variances]
    return tuple(min(bake.bounce_rays, max(FEWEST, one)) for one in needed)


def later_rays(decided: Decision, bake: BakeSettings, n_rays: Sequence[int]) -> tuple[int, ...]:
    """Choose the rays of a vertex of each part for the bounces after the first.

    What the second bounce sends is the first one's light once more: its energy, and with it the
    noise of a ray, is less by the share that the first one adds to direct light.
    """
    if noise_allowed(decided, bake) == 0.0:
        return tuple(n_rays)
    share = decided.evidence["first_bounce_share"]
    fewer = (share / LATER_SHARE) ** (1.0 / FALL)
    return tuple(min(own, max(FEWEST, ceil(own * fewer))) for own in n_rays)
