"""How many rays a vertex look for bounced light, from what one ray alone would miss."""

from math import ceil

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.planning.decision import Decision

FEWEST = 8
"""Below, the lattice has hardly begun to be better than chance."""

NOISE_SHARE = 0.5
"""Of the tolerance, that the rays' noise may take."""

FALL = 4.0 / 3.0
"""Squared errors fall with the rays to this power.

Shifted lattices in two dimensions reach 3/2 where the integrand jumps, as radiance does at
silhouettes, and 1 where it is all noise; 1.35 to 1.47 was measured from 1 to 64 rays.
"""


def bounce_rays(decided: Decision, bake: BakeSettings) -> tuple[int, ...]:
    """Choose the rays of a vertex of each part: ``bake.bounce_rays``, or fewer if noise allows it.

    Forcing interreflection takes them all: light below the tolerance would drown in noise that is
    measured by it.

    Parameters
    ----------
    decided
        On interreflection; ``variances`` of its evidence are the squared errors of one ray a vertex
        over the squared norm of a part's direct transfer.
    bake
        Settings, with the tolerance.
    """
    allowed = NOISE_SHARE * bake.bounce_tolerance
    variances = decided.evidence["variances"]
    if decided.forced or allowed == 0.0:
        return (bake.bounce_rays,) * len(variances)
    needed = [ceil((variance / allowed) ** (1.0 / FALL)) for variance in variances]
    return tuple(min(bake.bounce_rays, max(FEWEST, one)) for one in needed)
