"""Find workers that died and claims that never started, and give their work to the living."""

import logging
import threading
import time

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.queue.engine import Engine, JobQueue
from prtbake_storage.queue.heart import Heart
from prtbake_storage.queue.settings import QueueSettings
from prtbake_storage.records.workers import Workers

_log = logging.getLogger(__name__)

STALE_SCRATCH_S = 3600.0
"""Scratch of no known worker, such as a killed service's, is swept once untouched for so long."""


class Watchdog:
    """One round looks at every heartbeat, at claims of nobody, and at this worker's own claims.

    Once in ``dead_after_s`` it also looks at scratch.
    """

    def __init__(
        self,
        *,
        engine: Engine,
        queue: JobQueue,
        workers: Workers,
        heart: Heart,
        store: BlobStore,
        executor_id: str,
        settings: QueueSettings,
    ) -> None:
        self._engine, self._queue, self._workers = engine, queue, workers
        self._heart, self._store = heart, store
        self._executor_id, self._settings = executor_id, settings
        self._strangers: dict[str, float] = {}
        self._next_sweep = time.monotonic()

    def run(self, stop: threading.Event) -> None:
        """Look around once a heartbeat until told to stop."""
        while not stop.wait(self._settings.heartbeat_s):
            try:
                self.recover_dead()
                self.reap_orphans()
                self.sweep()
            except Exception as error:  # noqa: BLE001 - the next round may find the database again
                _log.warning("watchdog.failed", extra={"error": str(error)[:200]})

    def recover_dead(self) -> list[str]:
        """Queue again the work of workers that left, fell silent or are unknown; returns their ids.

        Unknown is who claimed something in the moment of leaving, after its peers had looked.
        """
        judge = self._heart.may_judge
        strange = self._strange()
        dead = strange if judge else []
        dead += [
            worker.executor_id
            for worker in self._workers.all()
            if worker.executor_id != self._executor_id
            and (worker.state == "gone" or (judge and worker.age_s > self._settings.dead_after_s))
        ]
        if not dead:
            return []
        recovered = self._engine.recover(dead)
        if recovered:
            _log.warning("worker.lost", extra={"workers": dead, "workflows": recovered})
        # forget a worker only when it holds nothing: work of another version waits for its own kind
        holding = {claim.executor_id for claim in self._queue.claims(dead)}
        gone = [executor_id for executor_id in dead if executor_id not in holding]
        for executor_id in gone:
            self._store.sweep_scratch(owner=executor_id)
        self._workers.forget(gone)
        return gone

    def reap_orphans(self) -> None:
        """Queue again what this worker claimed and never started."""
        claims = self._queue.claims([self._executor_id])
        # a start takes milliseconds
        for claim in self._engine.orphans(claims, after_s=self._settings.dead_after_s / 2):
            _log.warning("claim.orphaned", extra={"workflow": claim.workflow_id})
            self._queue.hand_back(claim)

    def sweep(self) -> None:
        """Remove what killed uploads left; a worker's scratch is swept when it is found dead."""
        if time.monotonic() < self._next_sweep:
            return
        self._next_sweep = time.monotonic() + self._settings.dead_after_s
        known = {worker.executor_id for worker in self._workers.all()}
        self._store.sweep_scratch(older_than_s=STALE_SCRATCH_S, keep=known)

    def _strange(self) -> list[str]:
        """Workers that hold claims and have not been listed for as long as the silent are given."""
        holding = {claim.executor_id for claim in self._queue.claims()}
        # looked at after the claims: whoever claims has beaten before
        known = {worker.executor_id for worker in self._workers.all()}
        now = time.monotonic()
        self._strangers = {name: self._strangers.get(name, now) for name in holding - known}
        after_s = self._settings.dead_after_s
        return [name for name, since in self._strangers.items() if now - since > after_s]
