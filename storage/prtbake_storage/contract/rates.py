"""What a job that has ended says of the cost model's rates, from the workers to the records."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class NewRates(NamedTuple):
    """Rates, or what they are off by.

    Attributes
    ----------
    seconds
        Stage -> unit -> seconds, where a calibration measured them all; they take the place of
        those before.
    ratios
        Stage -> measured over predicted seconds, predicted without what earlier jobs said.
    calibration
        The job that measured the rates which ``ratios`` go by; None for those that are shipped.
    """

    seconds: Mapping[str, Mapping[str, float]] | None = None
    ratios: Mapping[str, float] = MappingProxyType({})
    calibration: str | None = None
