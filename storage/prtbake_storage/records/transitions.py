"""Which state may follow which."""

from prtbake_storage.contract.jobs import TERMINAL, JobState

AFTER: dict[JobState, frozenset[JobState]] = {
    JobState.queued: frozenset(
        {JobState.running, JobState.canceled, JobState.failed, JobState.expired}
    ),
    JobState.running: frozenset(
        {JobState.cancel_requested, JobState.succeeded, JobState.failed, JobState.expired}
    ),
    JobState.cancel_requested: frozenset({JobState.canceled}),
    **{state: frozenset[JobState]() for state in TERMINAL},
}
"""State -> states that may follow it; nothing follows a terminal one."""


def before(state: JobState) -> frozenset[JobState]:
    """States from which ``state`` may be entered."""
    return frozenset(earlier for earlier, later in AFTER.items() if state in later)
