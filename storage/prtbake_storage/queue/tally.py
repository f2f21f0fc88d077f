"""The arithmetic of a job's progress."""

import time
from collections.abc import Sequence
from datetime import datetime

from prtbake_storage.contract.jobs import Progress
from prtbake_storage.queue.stages import Stage
from prtbake_storage.records.clock import utc_now
from prtbake_storage.records.runs import TaskProgress

ETA_FROM = 0.02
"""Share of the work to have seen before the rest is guessed."""


class Tally:
    """Adds finished and running tasks up to one fraction that never falls."""

    def __init__(self, stages: Sequence[Stage], started: datetime, fraction: float) -> None:
        self._weights = [max(stage.weight, 0.0) for stage in stages]
        self._whole = sum(self._weights) or 1.0
        self._stages = stages
        self._started = started
        # a job taken up again goes on from a fraction that this worker did not see grow
        self._first: tuple[float, float] | None = None
        self._fraction = fraction

    def at(
        self,
        index: int,
        done: int,
        total: int,
        under_way: Sequence[TaskProgress],
        *,
        rounds: tuple[int, int] = (0, 1),
    ) -> Progress:
        """Progress in stage ``index``: tasks done, tasks in all, and those that run.

        ``rounds`` are those before the one that these tasks are of, and the most there can be.
        """
        shares = [min(task.done / task.total, 1.0) for task in under_way if task.total > 0]
        part = min((done + sum(shares)) / total, 1.0) if total else 1.0
        ended, most = rounds
        part = min((ended + part) / most, 1.0)
        before = sum(self._weights[:index])
        fraction = (before + self._weights[index] * part) / self._whole
        self._fraction = max(self._fraction, min(fraction, 1.0))
        count: tuple[float, float, str] = (done, total, self._stages[index].unit)
        if most > 1:
            count = (ended, most, "rounds")
        elif total == 1 and done == 0 and under_way:
            # a single long task counts in its own unit
            task = under_way[0]
            count = (task.done, task.total, task.unit or self._stages[index].unit)
        return Progress(
            stage=self._stages[index].name,
            stage_index=index,
            stage_count=len(self._stages),
            fraction=self._fraction,
            done=count[0],
            total=count[1],
            unit=count[2],
            elapsed_s=self.elapsed_s,
            eta_s=self._eta(),
        )

    def finished(self) -> Progress:
        """Progress of a job that has succeeded."""
        return Progress(
            stage="",
            stage_index=len(self._stages),
            stage_count=len(self._stages),
            fraction=1.0,
            elapsed_s=self.elapsed_s,
            eta_s=0.0,
        )

    @property
    def elapsed_s(self) -> float:
        """Seconds since the job started, on whichever worker."""
        return max(0.0, (utc_now() - self._started).total_seconds())

    def _eta(self) -> float | None:
        now = time.monotonic()
        if self._first is None:
            self._first = (now, self._fraction)
            return None
        since, fraction = self._first
        gained = self._fraction - fraction
        if gained < ETA_FROM:
            return None
        return (now - since) * (1.0 - self._fraction) / gained
