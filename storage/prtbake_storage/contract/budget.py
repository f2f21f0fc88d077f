"""A budget: what an asset may cost, in place of the quality that says what it is made of."""

from typing import Annotated

from pydantic import Field, ValidationInfo, field_validator

from prtbake_storage.contract.base import Wire

FIELDS = ("max_error", "max_seconds")


class AssetBudget(Wire):
    """What an ``asset`` job may err by and take; one of them at least, and all that are given hold.

    Planning searches the settings: it tunes at views of the light that are not those of the
    validation, and the report lists what it tried.
    """

    max_error: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Relative L2 error of the pictures against the reference, as the error budget's total."""
    max_seconds: Annotated[float, Field(gt=0.0, le=7 * 86400.0)] | None = Field(
        default=None, validate_default=True
    )
    """Of the whole job, by the clock, from its start."""

    @field_validator("max_seconds")
    @classmethod
    def _one_at_least(cls, value: float | None, info: ValidationInfo) -> float | None:
        if value is None and "max_error" in info.data and info.data["max_error"] is None:
            raise ValueError(f"a budget sets one at least of {', '.join(FIELDS)}")
        return value
