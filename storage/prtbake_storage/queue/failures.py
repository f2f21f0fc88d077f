"""How tasks end without a result."""

import errno

from prtbake_storage.contract.jobs import JobError
from prtbake_storage.errors import PrtError

_PASSING = frozenset(
    {
        errno.EIO, errno.EAGAIN, errno.EINTR, errno.EBUSY, errno.ENFILE, errno.EMFILE, errno.ENOLCK,
        errno.ESTALE, errno.ETIMEDOUT, errno.ENOTCONN, errno.ENETDOWN, errno.ENETUNREACH,
        errno.EHOSTDOWN, errno.EHOSTUNREACH,
    }
)  # fmt: skip
"""What a restarting file server, a dropped network or a busy system says.  Neither a full disk nor
refused memory is here: they outlast our patience, and the caller should hear of them at once."""

SHUTDOWN = "shutdown"
"""Reason of a `TaskStopped` that means this worker, and not the job."""


LIMITS = frozenset({"cpu-limit", "out-of-memory"})
"""Codes of a task that came to a limit set for it: what it was given to read is at fault."""


class TaskFailed(Exception):
    """A task reported an error; ``retryable`` says whether another attempt may help."""

    def __init__(self, error: JobError, *, retryable: bool = False) -> None:
        super().__init__(error.detail)
        self.error = error
        self.retryable = retryable


class TaskStopped(Exception):
    """A task was stopped from outside before its end."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def may_pass(error: BaseException) -> bool:
    """Whether another attempt may succeed: our errors say so, the system's by their number."""
    if isinstance(error, TaskFailed | PrtError):
        return error.retryable
    if isinstance(error, OSError):
        return isinstance(error, ConnectionError | TimeoutError) or error.errno in _PASSING
    return False


def describe(error: BaseException, *, limited: bool = False) -> JobError:
    """Say what went wrong: our errors by their kind, the system's by what ran out or broke off.

    ``limited`` tells that memory was limited for the task's own sake: asking for more is then the
    fault of what it was given, and no machine would do better.
    """
    if isinstance(error, TaskFailed):
        return error.error
    if isinstance(error, PrtError):
        kind = error.kind if error.kind in ("input", "resource") else "internal"
        return JobError.model_validate(
            {"kind": kind, "code": error.code, "detail": error.detail, "pointer": error.pointer}
        )
    if isinstance(error, MemoryError):
        detail = str(error) or "the task ran out of memory"
        kind = "input" if limited else "resource"
        return JobError(kind=kind, code="out-of-memory", detail=detail)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return JobError(kind="resource", code="disk-full", detail=str(error))
    if isinstance(error, OSError) and may_pass(error):
        return JobError(kind="resource", code="io-error", detail=f"{type(error).__name__}: {error}")
    return JobError(kind="internal", code="internal", detail=f"{type(error).__name__}: {error}")
