"""A budget: what a job may err by, weigh and take; a quality decides what it leaves open."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from pydantic import Field, ValidationError, ValidationInfo, field_validator

from prtbake_storage.contract.base import MaxBytes, MaxError, MaxSeconds, Wire

FIELDS = ("max_error", "max_bytes", "max_seconds")


class Budget(Wire):
    """One limit at least, and all that are given hold; kinds of jobs say of what they are."""

    decided: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({})
    """Limit -> settings that it takes the place of, dotted; ``any`` -> those that each does."""

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

    def check_beside(self, given: Mapping[str, Any]) -> None:
        """Refuse settings that would decide what the budget decides.

        Parameters
        ----------
        given
            The settings that the request gives, and no defaults.

        Raises
        ------
        ValidationError
            Of the first of them, at its place in the settings.
        """
        for limit, names in self.decided.items():
            if limit != "any" and getattr(self, limit) is None:
                continue
            who = "the budget" if limit == "any" else f"budget.{limit}"
            for name in names:
                if given_at(given, name) is not None:
                    raise refused_at(name, f"{who} chooses {name}: give one of them")


def given_at(given: Mapping[str, Any], name: str) -> Any:
    """Look up a setting by its dotted name; None where it is not given."""
    stage, _, field = name.rpartition(".")
    return (given.get(stage, {}) if stage else given).get(field)


def refused_at(name: str, why: str) -> ValidationError:
    """Make the error of a setting, dotted, so that a validator of them all points at it."""
    error = {"type": "value_error", "loc": tuple(name.split(".")), "ctx": {"error": why}}
    return ValidationError.from_exception_data("settings", [error])  # type: ignore[list-item]
