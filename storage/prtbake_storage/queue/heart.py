"""A worker's heartbeat, and how far its judgement of others may be trusted."""

import logging
import os
import socket
import threading
import time

from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.records.workers import Workers

_log = logging.getLogger(__name__)


class Heart:
    """Beats for this worker.

    After an outage of the database, or a suspended host, every worker looks dead.  Nobody may be
    judged until one's own beats have gone well for as long as the others were given.
    """

    def __init__(self, workers: Workers, executor_id: str, settings: QueueSettings) -> None:
        self._workers = workers
        self._executor_id = executor_id
        self._settings = settings
        self._healthy_since = time.monotonic()
        self._last_beat = time.monotonic()

    def beat(self) -> None:
        """Write one heartbeat."""
        self._workers.beat(
            self._executor_id,
            host=socket.gethostname(),
            pid=os.getpid(),
            tile_slots=self._settings.tile_slots,
        )
        now = time.monotonic()
        if now - self._last_beat > self._settings.dead_after_s / 2:
            self._healthy_since = now
        self._last_beat = now

    def run(self, stop: threading.Event) -> None:
        """Beat until told to stop; a failing database is waited out."""
        while not stop.wait(self._settings.heartbeat_s):
            try:
                self.beat()
            except Exception as error:  # noqa: BLE001 - a worker must not die of a lost connection
                _log.warning("heartbeat.failed", extra={"error": str(error)[:200]})

    @property
    def may_judge(self) -> bool:
        """Whether this worker's view is steady enough to declare others dead."""
        now = time.monotonic()
        # a beat that hangs right now is an outage that the last good beat does not show
        steady = now - self._last_beat < self._settings.dead_after_s / 2
        return steady and now - self._healthy_since > self._settings.dead_after_s
