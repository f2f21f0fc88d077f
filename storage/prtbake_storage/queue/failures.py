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

OUT_OF_MEMORY, CPU_LIMIT = "out-of-memory", "cpu-limit"
"""Codes of a task that needed more than it may have.  Where that is a limit of the task's own, and
not the machine's end, it is the caller's to ask for less: `over_limit`."""

SHUTDOWN = "shutdown"
"""Reason of a `TaskStopped` that means this worker, and not the job."""


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


def over_limit(code: str, detail: str) -> JobError:
    """Say that what the caller gave needs more than a task may have, as input errors do."""
    return JobError(kind="input", code=code, detail=detail)


def may_pass(error: BaseException) -> bool:
    """Whether another attempt may succeed: our errors say so, the system's by their number."""
    if isinstance(error, TaskFailed | PrtError):
        return error.retryable
    if isinstance(error, OSError):
        return isinstance(error, ConnectionError | TimeoutError) or error.errno in _PASSING
    return False


def describe(error: BaseException) -> JobError:
    """Say what went wrong: our errors by their kind, the system's by what ran out or broke off."""
    if isinstance(error, TaskFailed):
        return error.error
    if isinstance(error, PrtError):
        kind = error.kind if error.kind in ("input", "resource") else "internal"
        return JobError.model_validate(
            {"kind": kind, "code": error.code, "detail": error.detail, "pointer": error.pointer}
        )
    if isinstance(error, MemoryError):
        detail = str(error) or "the task ran out of memory"
        return JobError(kind="resource", code=OUT_OF_MEMORY, detail=detail)
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return JobError(kind="resource", code="disk-full", detail=str(error))
    if isinstance(error, OSError) and may_pass(error):
        return JobError(kind="resource", code="io-error", detail=f"{type(error).__name__}: {error}")
    return JobError(kind="internal", code="internal", detail=f"{type(error).__name__}: {error}")
