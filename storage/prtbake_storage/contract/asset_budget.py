"""A budget of an asset: what it may err by, weigh and take."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from prtbake_storage.contract.base import MaxBytes, MaxError
from prtbake_storage.contract.budget import Budget, given_at, refused_at
from prtbake_storage.contract.settings import AssetSettings

SECONDS = ("compress.max_seconds", "fit_light.max_seconds")
"""A search, for an error or in a time, counts on stages that end with what they were asked for."""


class AssetBudget(Budget):
    """What an ``asset`` job may err by and take; one of them at least, and all that are given hold.

    For an error or a time planning searches the settings: it tunes at views of the light that are
    not those of the validation, and the report lists what it tried.  Bytes alone go with a quality.
    """

    decided: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({
        "max_error": (
            "compress.ranks",
            "compress.n_components",
            "compress.max_error",
            "compress.max_bytes",
            "compress.max_quantisation_error",
            "fit_light.n_lobes",
            "fit_light.max_error",
            "fit_light.max_bytes",
            *SECONDS,
        ),
        "max_bytes": (
            "compress.ranks",
            "compress.n_components",
            "compress.max_error",
            "compress.max_bytes",
            "compress.max_quantisation_error",
        ),
        "max_seconds": SECONDS,
    })  # fmt: skip

    max_error: MaxError | None = None
    """Relative L2 error of the pictures against the reference, as the error budget's total."""
    max_bytes: MaxBytes | None = None
    """Of `asset.h5` as it is written, mesh and tables included; the light is another file."""

    @property
    def searched(self) -> bool:
        """Whether the quality is: bytes alone are met at any."""
        return self.max_error is not None or self.max_seconds is not None

    def laid_over(self, settings: AssetSettings) -> AssetSettings:
        """Let bytes that stand alone decide the compression; a search holds attempts to them."""
        if self.max_bytes is None or self.searched:
            return settings
        compress = settings.compress | {"max_bytes": self.max_bytes}
        return settings.model_copy(update={"compress": compress})

    def check_beside(self, given: Mapping[str, Any]) -> None:
        """Refuse settings that would decide what the budget decides, too few bits among them.

        Raises
        ------
        ValidationError
            Of the first of them, at its place in the settings.
        """
        super().check_beside(given)
        bits = given_at(given, "compress.bits")
        if self.max_bytes is not None and bits in (8, 16):
            why = "budget.max_bytes chooses compress.bits: leave them 'auto'"
            raise refused_at("compress.bits", why)
        if self.max_error is not None and bits == 8:
            why = "budget.max_error chooses compress.bits: leave them 'auto', or 16"
            raise refused_at("compress.bits", why)
