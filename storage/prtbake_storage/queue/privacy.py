"""Keep other processes of our user out of this one."""

import ctypes
import sys

_PR_SET_DUMPABLE = 4


def forbid_reading() -> None:
    """Close ``/proc/PID/environ`` and memory, where the secrets of the settings lie.

    A task's process runs as the same user and reads files from outside.  It could read on from
    there, although its own environment holds none.  Only Linux can be told.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)
