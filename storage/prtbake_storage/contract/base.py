"""What all wire models share."""

from datetime import UTC, datetime
from typing import Annotated

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    ConfigDict,
    Field,
    StringConstraints,
)


class Wire(BaseModel):
    """A model that goes over the wire: unknown fields and non-finite numbers are refused.

    A docstring below a field is its description in the schema.
    """

    model_config = ConfigDict(
        extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


Digest = Annotated[str, StringConstraints(pattern=r"^sha256:[0-9a-f]{64}$")]
"""Content address of a blob."""

ResourceId = Annotated[str, Field(pattern=r"^(mesh|brdf|environment)-[0-9a-f]{16}$")]
"""A registered upload."""

Label = Annotated[str, StringConstraints(max_length=200, pattern=r"^[^\x00]*$")]
"""A name for people; PostgreSQL's texts hold every character but NUL."""


def _in_utc(moment: datetime) -> datetime:
    try:
        return moment.astimezone(UTC)
    except OverflowError as error:
        raise ValueError("this moment lies outside the years 1 to 9999 of UTC") from error


Moment = Annotated[AwareDatetime, AfterValidator(_in_utc)]
"""A point in time, in UTC."""

Fraction = Annotated[float, Field(ge=0.0, le=1.0)]
Positive = Annotated[float, Field(gt=0.0)]
MaxError = Annotated[float, Field(gt=0.0, lt=1.0)]
"""What a result may err by; whether squared and of what, its field says."""
MaxBytes = Annotated[int, Field(ge=1, lt=2**53)]
"""What a file may weigh: counts below 2^53 are exact in JSON's numbers."""
MaxSeconds = Annotated[float, Field(gt=0.0, le=7 * 86400.0)]
"""What work may take; a week at most."""
Vec3 = tuple[float, float, float]
Rgb = tuple[Fraction, Fraction, Fraction]
