"""The search for settings whose pictures err by little enough in a number of bytes: its decisions.

Compressions for an error make the smallest file they can.  Where that is too large, the least error
of the bytes is made of the same bake, and of a finer one where that may do: bytes are what counts
then, and a bake that leaves less lets them leave more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

from prtbake_workers.planning.error_search import TRUST, WINDOW, Compression

WORTH = 0.97
"""Of the error that is left, that another bake is predicted to lower it to at least."""

MENDED_ROOM = 2.0
"""By which a file has to be smaller than it may be for one of a smaller error to fit: mending asks
for half of a squared error or more, and sizes go by less than its inverse."""


@dataclass(frozen=True)
class Left:
    """What tuning views show of an asset that has all of its bytes, step by step.

    Attributes
    ----------
    transfer, light, total
        Relative L2 errors: of the stored transfer, with the light, with the compression.
    """

    transfer: float
    light: float
    total: float

    @property
    def fit(self) -> float:
        """What the light added."""
        return _added(self.light, self.transfer)

    @property
    def compression(self) -> float:
        """What the compression added."""
        return _added(self.total, self.light)

    def with_transfer(self, transfer: float) -> float:
        """Predict the total at another bake: light and compression add what they do here."""
        return sqrt(transfer**2 + self.fit**2 + self.compression**2)

    def largest(self, line_of_bake: str) -> str:
        """Name the largest part; that of the bake goes by the name of its largest line."""
        parts = {
            line_of_bake: self.transfer,
            "light fit": self.fit,
            "compression": self.compression,
        }
        return max(parts, key=lambda name: parts[name])


def _added(after: float, before: float) -> float:
    return sqrt(max(after**2 - before**2, 0.0))


def beyond_bytes(total: float | None, size: int | None, aim: float, most: int | None) -> bool:
    """Tell whether a compression shows that no other for an error does with the bytes.

    It takes more, and one that errs by more would err by too much.
    """
    if most is None or total is None or size is None:
        return False
    return size > most and total >= WINDOW[0] * aim


def within(
    tried: Sequence[Compression], sizes: Sequence[int | None], most: int | None
) -> list[Compression]:
    """Give compressions as they were tried, those of too many bytes as if they had refused."""
    return [
        (asked, None if most is not None and size is not None and size > most else total)
        for (asked, total), size in zip(tried, sizes, strict=True)
    ]


def finer_step(step: int, predictions: Sequence[float], left: Left, aim: float) -> int | None:
    """Choose another bake for the same bytes.

    Parameters
    ----------
    step
        Of the bake that ``left`` was measured on.
    predictions
        What the stored transfer of every step errs by.
    aim
        That the total is to stay below.

    Returns
    -------
    int or None
        The lowest step above that is predicted to do, the best where its prediction may be too high
        by no more than `TRUST`, None where none is in reach, or changes next to nothing.
    """
    if not predictions[step]:
        return None
    predicted = {
        other: left.with_transfer(_transfer_at(step, other, predictions, left))
        for other in range(step + 1, len(predictions))
    }
    ahead = {other: total for other, total in predicted.items() if total <= WORTH * left.total}
    doing = [other for other, total in ahead.items() if total <= aim]
    if doing:
        return doing[0]
    best = min(ahead, key=lambda other: ahead[other], default=None)
    return best if best is not None and ahead[best] <= TRUST * aim else None


def of_finer(step: int, finer: int, predictions: Sequence[float], left: Left, total: float) -> Left:
    """Say what is left at another bake, of which tuning views show the ``total`` alone.

    The stored transfer is taken as predicted, and the light to add what it did at ``step``.
    """
    transfer = _transfer_at(step, finer, predictions, left)
    return Left(transfer, sqrt(transfer**2 + left.fit**2), total)


def _transfer_at(step: int, other: int, predictions: Sequence[float], left: Left) -> float:
    """Predict the stored transfer at another step, as the measured one corrects it."""
    return left.transfer * predictions[other] / predictions[step]


def bytes_needed(tried: Sequence[Compression], sizes: Sequence[int | None], aim: float) -> str:
    """Say in how many bytes a compression met the aim, or in how many at most none did."""
    met: list[int] = []
    above: list[int] = []
    for (_, total), size in zip(tried, sizes, strict=True):
        if total is not None and size is not None:
            (met if total <= WINDOW[1] * aim else above).append(size)
    return f"{min(met)} bytes" if met else f"more than {max(above, default=0)} bytes"


def mended_by_bytes(size: int, most: int | None) -> bool:
    """Tell whether an asset that errs by too much is made anew of all its bytes.

    Otherwise of a smaller error: its file has room to grow.
    """
    return most is not None and MENDED_ROOM * size > most
