"""When a fit has to end: with what it has so far, between two steps.

A deadline holds for all that runs within `ends_by`, as the number of threads does within
`same_bytes_on_any_threads`: fits are made of fits, and none of them has a use for it but the loops,
which ask `time_for` before they take another step.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

SLACK = 1.2
"""Of what a step took, for the next one and for handing over what it leaves."""


class Deadline:
    """A number of seconds from now on.

    Parameters
    ----------
    seconds
        Until it is over; nothing and less is over already.
    clock
        Seconds, never falling.

    Attributes
    ----------
    hit
        Whether a step was not taken for want of time.
    kept
        Seconds that what comes after the last step takes.
    """

    def __init__(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._began, self._seconds = clock(), seconds
        self.hit = False
        self.kept = 0.0

    @property
    def spent(self) -> float:
        """Seconds since it was made."""
        return self._clock() - self._began

    def allows(self, seconds: float) -> bool:
        """Whether a step of about so many seconds ends in time."""
        if self.spent + SLACK * (seconds + self.kept) <= self._seconds:
            return True
        self.hit = True
        return False


_current: ContextVar[Deadline | None] = ContextVar("deadline", default=None)


@contextmanager
def ends_by(deadline: Deadline | None) -> Iterator[None]:
    """Hold what runs inside to a deadline; None to none."""
    token = _current.set(deadline)
    try:
        yield
    finally:
        _current.reset(token)


def keep_time(seconds: float) -> None:
    """Keep seconds for what comes after the last step, where there is a deadline."""
    deadline = _current.get()
    if deadline is not None:
        deadline.kept = seconds


def time_for(seconds: float) -> bool:
    """Whether a step of about so many seconds may be taken."""
    deadline = _current.get()
    return deadline is None or deadline.allows(seconds)
