"""Run a job: walk its stages, queue their tasks, wait, and end it in one transaction.

Nothing here is recorded by the engine.  The same walk may begin again on another worker at any
point: finished tasks are recalled from the blob store, queued ones are found by their ids, and each
change of the job's row is a compare-and-set.
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ParamSpec, TypeVar

from prtbake_storage.contract.jobs import JobError, JobState
from prtbake_storage.errors import PrtError
from prtbake_storage.queue.attempts import Attempts
from prtbake_storage.queue.engine import ENDED, GIVEN_UP, JobQueue, poison, task_id
from prtbake_storage.queue.failures import SHUTDOWN, TaskFailed, TaskStopped, describe
from prtbake_storage.queue.memo import Memory, enter, recall
from prtbake_storage.queue.patience import patiently
from prtbake_storage.queue.stages import ArtefactFile, Finished, JobRunner, Results, Task
from prtbake_storage.queue.tally import Tally
from prtbake_storage.queue.tasks import Outcome, Services, TaskRun
from prtbake_storage.records.events import Events
from prtbake_storage.records.runs import NewArtefact, Run, Stop

P = ParamSpec("P")
R = TypeVar("R")

_log = logging.getLogger(__name__)

WINDOW = 64
"""Tasks of a job in the queue at once: enough for any fleet here, few enough to poll and cancel."""

PROGRESS_EVERY_S = 1.0
STOP_PATIENCE_S = 10.0
"""How long a stopping job waits for its running tasks: their workers may be dead."""


class _Stopped(Exception):
    """The job must end now, and how."""

    def __init__(self, stop: Stop) -> None:
        super().__init__(stop.state)
        self.stop = stop


@dataclass
class _Work:
    """A stage under way: what waits, what is in the queue, what is done, what was lost again.

    Tasks of all rounds so far are counted on; the present round's begin at ``first``.
    """

    index: int
    most_rounds: int = 1
    round: int = -1
    first: int = 0
    tasks: list[Task] = field(default_factory=list)
    waiting: deque[int] = field(default_factory=deque)
    queued: dict[str, int] = field(default_factory=dict)
    done: dict[int, Memory] = field(default_factory=dict)
    losses: Counter[int] = field(default_factory=Counter)
    recalled: bool = False

    def begin(self, tasks: list[Task]) -> None:
        """Begin a round of these tasks."""
        self.round += 1
        self.first = len(self.tasks)
        self.tasks += tasks

    @property
    def positions(self) -> range:
        """Those of the present round's tasks."""
        return range(self.first, len(self.tasks))


class JobRun:
    """One walk through a job's stages on this worker."""

    def __init__(
        self, services: Services, queue: JobQueue, runner: JobRunner, job_id: str, *, quick: bool
    ) -> None:
        self._services, self._queue, self._runner = services, queue, runner
        self._job_id, self._quick = job_id, quick
        self._next_progress = 0.0
        self._attempts = Attempts(
            services.settings, services.shutdown, check_stop=self._check_stop, tell=self._retrying
        )

    def run(self) -> None:
        """Run to a terminal state; raises `TaskStopped` only when this worker shuts down."""
        run = self._patiently(self._services.runs.start, self._job_id)
        if run is None:
            return
        _log.info("job.started", extra={"job_id": self._job_id, "kind": run.kind})
        try:
            self._walk(run)
        except _Stopped as stopped:
            self._end(stopped.stop)
        except TaskStopped:
            raise
        except TaskFailed as failed:
            self._fail(failed.error)
        except PrtError as error:  # on purpose: from the job's kind, or a blob that is gone
            self._fail(describe(error))
        except Exception as error:  # noqa: BLE001 - logged whole, and the job's end says it
            _log.exception("job.crashed", extra={"job_id": self._job_id})
            self._fail(describe(error))

    def _walk(self, run: Run) -> None:
        stages = self._runner.stages(run.kind, run.request, run.context)
        tally = Tally(stages, run.started, run.fraction)
        results = Results()
        for index, stage in enumerate(stages):
            self._check_stop()
            work = _Work(index, 1 if stage.rounds is None else stage.rounds.most(results))
            for tasks in stage.lists(results):
                work.begin(tasks)
                looked = time.monotonic()
                for position in work.positions:
                    task = work.tasks[position]
                    # a study has thousands, and a store may be far away
                    if time.monotonic() - looked >= PROGRESS_EVERY_S:
                        self._check_stop()
                        looked = time.monotonic()
                    if (memory := self._recall(task, task.key)) is not None:
                        work.done[position] = memory
                    else:
                        work.waiting.append(position)
                work.recalled = len(work.done) > work.first
                self._report(tally, work, now=True)
                self._run_here(tally, work) if self._quick else self._run_queued(tally, work, run)
                memories = [work.done[position] for position in work.positions]
                enter(results, stage, memories, recalled=work.recalled)
        finished = self._runner.finish(run.kind, run.request, run.context, results)
        self._succeed(finished, tally)

    def _run_here(self, tally: Tally, work: _Work) -> None:
        """Run a quick job's tasks in its own slot, one after the other."""
        while work.waiting:
            position = work.waiting.popleft()
            task = work.tasks[position]
            outcome = TaskRun(self._services, self._job_id, work.index, position, task).run()
            self._take(work, position, outcome)
            self._report(tally, work)

    def _run_queued(self, tally: Tally, work: _Work, run: Run) -> None:
        """Keep a window of tasks in the queue until all are done."""
        while work.waiting or work.queued:
            self._check_stop()
            while work.waiting and len(work.queued) < WINDOW:
                position = work.waiting.popleft()
                task = work.tasks[position]
                workflow_id = self._patiently(
                    self._queue.submit_task,
                    self._job_id,
                    work.index,
                    position,
                    task.to_dict(),
                    key=task.key,
                    priority=run.priority,
                )
                work.queued[workflow_id] = position
            statuses = self._patiently(self._queue.statuses, list(work.queued))
            for workflow_id, status in statuses.items():
                if status in ENDED:
                    outcome = self._outcome(workflow_id, status)
                    self._take(work, work.queued.pop(workflow_id), outcome)
            self._report(tally, work)
            if work.queued and self._services.shutdown.wait(self._services.settings.poll_s):
                raise TaskStopped(SHUTDOWN)

    def _outcome(self, workflow_id: str, status: str) -> Outcome:
        output = self._patiently(self._queue.output, workflow_id)
        if status == "SUCCESS" and isinstance(output, dict):
            return Outcome.from_dict(output)
        if status == GIVEN_UP:
            losses = self._services.settings.worker_losses
            return Outcome("failed", poison(f"{losses} workers were lost while they ran this task"))
        detail = f"a task ended as {status}: {str(output)[:500]}"
        return Outcome("failed", JobError(kind="internal", code="engine", detail=detail))

    def _take(self, work: _Work, position: int, outcome: Outcome) -> None:
        if outcome.status == "failed" and outcome.error is not None:
            self._check_stop()  # a cancellation asked for comes before an error
            raise TaskFailed(outcome.error)
        memory = self._recall(work.tasks[position], outcome.key) if outcome.key else None
        if memory is None:
            self._check_stop()
            self._run_again(work, position)
        else:
            work.done[position] = memory
            work.recalled |= outcome.recalled

    def _recall(self, task: Task, key: str) -> Memory | None:
        return self._attempts.make(f"recalling {task.title}", recall, self._services.store, key)

    def _run_again(self, work: _Work, position: int) -> None:
        """Put a task back whose result is not remembered any more, or lacks a blob."""
        task = work.tasks[position]
        work.losses[position] += 1
        if (losses := work.losses[position]) == self._services.settings.task_attempts:
            detail = f"the result of {task.title} was made and lost {losses} times"
            raise TaskFailed(JobError(kind="internal", code="lost-result", detail=detail))
        if not self._quick:
            workflow_id = task_id(self._job_id, work.index, position, task.key)
            self._patiently(self._queue.forget, workflow_id)
        work.waiting.append(position)

    def _report(self, tally: Tally, work: _Work, *, now: bool = False) -> None:
        if not now and time.monotonic() < self._next_progress:
            return
        self._next_progress = time.monotonic() + PROGRESS_EVERY_S
        under_way = self._patiently(self._services.runs.tasks_under_way, self._job_id, work.index)
        running = [task for task in under_way if task.position not in work.done]
        done, total = len(work.done) - work.first, len(work.positions)
        rounds = (work.round, work.most_rounds)
        progress = tally.at(work.index, done, total, running, rounds=rounds)
        self._patiently(self._services.runs.progress, self._job_id, progress)

    def _succeed(self, finished: Finished, tally: Tally) -> None:
        artefacts = [self._artefact(ArtefactFile(*file)) for file in finished.artefacts]
        published = self._patiently(
            self._services.runs.succeed,
            self._job_id,
            result=finished.result,
            artefacts=artefacts,
            progress=tally.finished(),
            rates=finished.rates,
        )
        if not published:
            self._check_stop()
            return
        _log.info("job.succeeded", extra={"job_id": self._job_id, "seconds_s": tally.elapsed_s})

    def _artefact(self, file: ArtefactFile) -> NewArtefact:
        size = self._attempts.make(f"measuring {file.name}", self._services.store.size, file.digest)
        return NewArtefact(file.name, file.media_type, file.digest, size)

    def _retrying(self, detail: str) -> None:
        _log.warning("job.retried", extra={"job_id": self._job_id, "error": detail})
        events = Events(self._services.database)
        self._patiently(events.log, self._job_id, f"retrying after: {detail}")

    def _check_stop(self) -> None:
        if self._services.shutdown.is_set():
            raise TaskStopped(SHUTDOWN)
        stop = self._patiently(self._services.runs.stop, self._job_id)
        if stop is not None:
            raise _Stopped(stop)

    def _fail(self, error: JobError) -> None:
        self._patiently(self._services.runs.fail_soon, self._job_id, error)
        self._end(Stop(JobState.failed, error))

    def _end(self, stop: Stop) -> None:
        """Take the tasks off the queue, wait for those that run to stop, and close the row."""
        deadline = time.monotonic() + STOP_PATIENCE_S
        while not self._quick and (tasks := self._patiently(self._queue.open_tasks, self._job_id)):
            late = time.monotonic() > deadline
            ending = [name for name, status in tasks.items() if late or status == "ENQUEUED"]
            self._patiently(self._queue.cancel, ending)
            if self._services.shutdown.wait(self._services.settings.poll_s):
                raise TaskStopped(SHUTDOWN)
        closed = self._patiently(self._services.runs.close, self._job_id, stop)
        if closed:
            detail = stop.error.detail if stop.error is not None else None
            fields = {"job_id": self._job_id, "state": stop.state.value, "error": detail}
            _log.info("job.ended", extra=fields)

    def _patiently(self, call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        return patiently(self._services.shutdown, call, *args, **kwargs)
