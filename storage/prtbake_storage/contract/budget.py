"""A budget: what a job may err by, weigh and take; a quality decides what it leaves open."""

from pydantic import Field, ValidationInfo, field_validator

from prtbake_storage.contract.base import MaxBytes, MaxError, MaxSeconds, Wire

FIELDS = ("max_error", "max_bytes", "max_seconds")


class Budget(Wire):
    """One limit at least, and all that are given hold; kinds of jobs say of what they are."""

    max_error: MaxError | None = None
    max_bytes: MaxBytes | None = None
    max_seconds: MaxSeconds | None = Field(default=None, validate_default=True)
    """Of the whole job, by the clock, from its start."""

    @field_validator("max_seconds")
    @classmethod
    def _one_at_least(cls, value: float | None, info: ValidationInfo) -> float | None:
        # a field that was refused itself is missing
        if value is None and all(info.data.get(name, 0) is None for name in FIELDS[:-1]):
            raise ValueError(f"a budget sets one at least of {', '.join(FIELDS)}")
        return value
