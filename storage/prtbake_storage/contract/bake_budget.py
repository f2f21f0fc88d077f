"""A budget of a lone bake: what its transfer may err by, weigh and take, in place of a quality."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from prtbake_storage.contract.base import MaxBytes, MaxError
from prtbake_storage.contract.budget import Budget, refused_at

MOST_CENTRES_TRIED = 2562


class BakeBudget(Budget):
    """What a ``bake`` job may leave, weigh and take; one of them at least, all given ones hold.

    Planning tries directions and centres at some vertices, chooses them with the terms of the
    BRDFs, bakes, and corrects its choice by what the bake measured of itself.
    """

    decided: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({
        "any": ("term_energy_lost", "projection_tolerance"),
        "max_error": ("bounce_tolerance", "subsurface_tolerance"),
    })  # fmt: skip

    max_error: MaxError | None = None
    """Relative L2 error of the transfer by the bake's own account, of the part that it is largest
    of; not that of pictures, and without interpolation between vertices."""
    max_bytes: MaxBytes | None = None
    """Of `transfer.h5`."""

    def check_beside(self, given: Mapping[str, Any]) -> None:
        """Refuse settings that would decide what the budget decides, or that no trial goes with.

        Raises
        ------
        ValidationError
            Of the first of them, at its place in the settings.
        """
        super().check_beside(given)
        if given.get("basis", "srbf") != "srbf":
            why = "the budget chooses n_centres of basis 'srbf': basis 'sh' has none"
            raise refused_at("basis", why)
        centres = given.get("n_centres")
        if isinstance(centres, int) and centres > MOST_CENTRES_TRIED:
            why = f"beside a budget n_centres are {MOST_CENTRES_TRIED} at most"
            raise refused_at("n_centres", why)
        if given.get("bandwidth") is not None and not isinstance(centres, int):
            why = "the budget chooses n_centres: a bandwidth goes with a number of them"
            raise refused_at("bandwidth", why)
