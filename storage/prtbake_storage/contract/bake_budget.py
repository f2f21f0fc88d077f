"""A budget of a lone bake: what its transfer may err by, weigh and take, in place of a quality."""

from collections.abc import Mapping
from typing import Any

from prtbake_storage.contract.base import MaxBytes, MaxError
from prtbake_storage.contract.budget import Budget

DECIDED_BY_ANY = ("term_energy_lost", "projection_tolerance")
"""Settings of the bake that any budget takes the place of."""

DECIDED_BY_ERROR = ("bounce_tolerance", "subsurface_tolerance")
"""Those that an error does."""

MOST_CENTRES_TRIED = 2562


class BakeBudget(Budget):
    """What a ``bake`` job may leave, weigh and take; one of them at least, all given ones hold.

    Planning tries directions and centres at some vertices, chooses them with the terms of the
    BRDFs, bakes, and corrects its choice by what the bake measured of itself.
    """

    max_error: MaxError | None = None
    """Relative L2 error of the transfer by the bake's own account, of the part that it is largest
    of; not that of pictures, and without interpolation between vertices."""
    max_bytes: MaxBytes | None = None
    """Of `transfer.h5`."""

    def check_beside(self, given: Mapping[str, Any]) -> None:
        """Refuse settings that would decide what the budget decides.

        Parameters
        ----------
        given
            Fields of the bake's settings that the request gives.

        Raises
        ------
        ValueError
            Naming the first of them.
        """
        names = DECIDED_BY_ANY + (DECIDED_BY_ERROR if self.max_error is not None else ())
        for name in names:
            if given.get(name) is not None:
                raise ValueError(f"the budget chooses {name}: give one of them")
        if given.get("basis", "srbf") != "srbf":
            raise ValueError("the budget chooses n_centres of basis 'srbf': basis 'sh' has none")
        centres = given.get("n_centres")
        if isinstance(centres, int) and centres > MOST_CENTRES_TRIED:
            raise ValueError(f"beside a budget n_centres are {MOST_CENTRES_TRIED} at most")
        if given.get("bandwidth") is not None and not isinstance(centres, int):
            raise ValueError("the budget chooses n_centres: a bandwidth goes with a number of them")
