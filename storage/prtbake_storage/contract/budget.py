"""A budget: what an asset may cost, in place of the quality that says what it is made of."""

from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from prtbake_storage.contract.base import Wire
from prtbake_storage.contract.settings import AssetSettings

FIELDS = ("max_error", "max_bytes", "max_seconds")


class AssetBudget(Wire):
    """What an ``asset`` job may err by and take; one of them at least, and all that are given hold.

    For an error or a time planning searches the settings: it tunes at views of the light that are
    not those of the validation, and the report lists what it tried.  Bytes alone go with a quality.
    """

    max_error: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Relative L2 error of the pictures against the reference, as the error budget's total."""
    max_bytes: Annotated[int, Field(ge=1, lt=2**53)] | None = None
    """Of `asset.h5` as it is written, mesh and tables included; the light is another file."""
    max_seconds: Annotated[float, Field(gt=0.0, le=7 * 86400.0)] | None = Field(
        default=None, validate_default=True
    )
    """Of the whole job, by the clock, from its start."""

    @field_validator("max_seconds")
    @classmethod
    def _one_at_least(cls, value: float | None, info: ValidationInfo) -> float | None:
        # a field that was refused itself is missing
        if value is None and all(info.data.get(name, 0) is None for name in FIELDS[:-1]):
            raise ValueError(f"a budget sets one at least of {', '.join(FIELDS)}")
        return value

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
