"""A logarithmic axis: where values stand on it, and its ticks."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, log10

ROOM = 0.05
"""Of the axis beyond its outermost values, and at least this part of a decade."""

FACTORS: Sequence[Sequence[float]] = (
    (1.0,),
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0),
    tuple(n / 10 for n in range(10, 100, 2)),
    tuple(n / 20 for n in range(20, 200)),
)
"""Within a decade, from coarse to fine."""
ENOUGH = 3


@dataclass(frozen=True)
class LogAxis:
    """An axis from ``start`` to ``stop`` (pixels) over ``low`` to ``high`` (powers of ten)."""

    low: float
    high: float
    start: int | float
    stop: int | float

    @classmethod
    def over(
        cls, values: Sequence[int | float], start: int | float, stop: int | float
    ) -> "LogAxis":
        """Span values >= 0; a zero stands at the lower end, apart from the others."""
        above = [value for value in values if value > 0]
        low, high = (log10(min(above)), log10(max(above))) if above else (0.0, 0.0)
        room = max(ROOM * (high - low), ROOM)
        return cls(
            low - (room if len(above) == len(values) else 4 * room), high + room, start, stop
        )

    def place(self, value: int | float) -> float:
        """Give the pixel of a value."""
        at = log10(value) if value > 0 else self.low
        return self.start + (self.stop - self.start) * (at - self.low) / (self.high - self.low)

    def ticks(self) -> list[float]:
        """List the coarsest round numbers that mark the axis at three places or more."""
        decades = range(floor(self.low), ceil(self.high) + 1)
        found: list[float] = []
        for factors in FACTORS:
            every = [factor * 10.0**decade for decade in decades for factor in factors]
            found = [tick for tick in every if self.low <= log10(tick) <= self.high]
            if len(found) >= ENOUGH:
                break
        return found
