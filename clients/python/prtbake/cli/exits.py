"""Exit codes of the command line, stable and documented in ``prtbake --help``."""

from enum import IntEnum

from prtbake_storage.contract.jobs import JobState


class Exit(IntEnum):
    """0 is success, and nothing else is."""

    success = 0
    error = 1  # something of ours or of this machine
    usage = 2  # arguments that make no sense
    failed = 3  # the job failed
    canceled = 4  # the job was canceled
    expired = 5  # the job ran out of time
    refused = 6  # the service refused the request
    unreachable = 7  # no service answered
    timeout = 8  # the job goes on, the waiting does not
    corrupt = 9  # a download that does not match its digest
    service = 10  # the service is at fault or overloaded
    interrupted = 130  # Ctrl-C


LEGEND = (
    "Exit codes: 0 success, 1 error, 2 usage, 3 job failed, 4 job canceled, 5 job expired,"
    " 6 request refused, 7 service unreachable, 8 wait timed out, 9 download corrupt,"
    " 10 service failed or overloaded."
)

_OF_STATE = {
    JobState.succeeded: Exit.success,
    JobState.failed: Exit.failed,
    JobState.canceled: Exit.canceled,
    JobState.expired: Exit.expired,
}


def exit_of(state: JobState) -> Exit:
    """Return the code for a terminal state."""
    return _OF_STATE[state]
