"""What a task is given beside its arguments."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from prtbake_storage.blobs.base import BlobStore

PROGRESS_EVERY_S = 0.5
"""Progress is for people: more messages than this would only load the database."""


class TaskContext:
    """The world as a task sees it.

    Attributes
    ----------
    store
        Blobs; what a task leaves must be put there.
    scratch
        An empty folder, removed when the task ends in any way.
    settings_at
        JSON pointer to the settings of the task in the request, for errors.
    """

    def __init__(
        self,
        store: BlobStore,
        scratch: Path,
        send: Callable[[dict[str, Any]], None],
        *,
        settings_at: str = "/settings",
    ) -> None:
        self.store = store
        self.scratch = scratch
        self.settings_at = settings_at
        self._send = send
        self._last = 0.0

    def progress(self, done: float, total: float, unit: str = "") -> None:
        """Say how far the task is; call it as often as you like."""
        now = time.monotonic()
        if done < total and now - self._last < PROGRESS_EVERY_S:
            return
        self._last = now
        self._send({"progress": [float(done), float(total), unit]})

    def log(self, message: str, **fields: Any) -> None:
        """Add a line to the job's log."""
        self._send({"log": {"message": message, **fields}})
