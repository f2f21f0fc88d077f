"""A budget of attempts for what may fail in passing: a task's process, or the store behind it."""

import threading
import time
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from prtbake_storage.queue.failures import TaskFailed, describe, may_pass
from prtbake_storage.queue.settings import QueueSettings

P = ParamSpec("P")
R = TypeVar("R")

LOOK_S = 0.25
"""How often a wait looks whether it should end."""


class Attempts:
    """Calls again what failed in a way that may pass, ``task_attempts`` times in all.

    Parameters
    ----------
    settings
        The budget, and ``retry_wait_s``: the first wait, which doubles with each attempt.
    shutdown
        Set when the worker leaves.
    check_stop
        Called while waiting; it raises when there is no more reason to go on.
    tell
        Told before each further attempt what went wrong.
    """

    def __init__(
        self,
        settings: QueueSettings,
        shutdown: threading.Event,
        *,
        check_stop: Callable[[], None],
        tell: Callable[[str], None],
    ) -> None:
        self._settings, self._shutdown = settings, shutdown
        self._check_stop, self._tell = check_stop, tell

    def make(self, what: str, call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Call until it succeeds or the budget is spent.

        Raises
        ------
        TaskFailed
            The last attempt's error; it says what was tried how often.
        Exception
            As it came, when another attempt would not help.
        """
        budget = self._settings.task_attempts
        for attempt in range(1, budget + 1):
            try:
                return call(*args, **kwargs)
            except Exception as error:
                if not may_pass(error):
                    raise
                described = describe(error)
                if attempt == budget:
                    detail = f"{what}, tried {budget} times: {described.detail}"
                    raise TaskFailed(described.model_copy(update={"detail": detail})) from error
                self._tell(described.detail)
                self._pause(self._settings.retry_wait_s * 2 ** (attempt - 1))
        raise AssertionError("unreachable: the last attempt returns or raises")

    def _pause(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0.0:
            self._check_stop()
            self._shutdown.wait(min(LOOK_S, left))
