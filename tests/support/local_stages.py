"""Run a job's stages in this process: the same task functions, without queue or children."""

import importlib
import json
import time
from collections.abc import Callable, Collection
from typing import Any

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.queue.context import TaskContext
from prtbake_storage.queue.stages import Measured, Results, Stage, Task
from prtbake_workers.jobs import register

SHARED = "prtbake_workers.jobs.fit_light:fit"
"""Jobs of one store and sky have this task in common: what it left is taken up, not made anew."""

PARSED = frozenset(
    f"prtbake_workers.jobs.register:parse_{kind}" for kind in ("mesh", "environment")
)
"""Most scenes of tests are of the same few meshes and skies."""

_left: dict[tuple[str, str, str], tuple[Any, float]] = {}


def run_stages(
    stages: list[Stage], store: BlobStore, shared: Collection[str] = (SHARED,)
) -> Results:
    """Run every task of every stage in order; arguments and results pass through JSON.

    Functions that are ``shared`` run once for the same arguments in one store.  Measured of such a
    task again is what it took when it ran, but for `SHARED`, which counts as free.
    """
    results = Results()
    for stage in stages:
        run_stage(stage, results, store, shared=shared)
    return results


def run_stage(
    stage: Stage,
    results: Results,
    store: BlobStore,
    clock: Callable[[], float] = time.perf_counter,
    shared: Collection[str] = (SHARED,),
) -> None:
    """Run the tasks of one stage and enter what they returned and how long they took."""
    for tasks in stage.lists(results):
        values, measured = _run(tasks, store, clock, shared)
        add = results.add if stage.rounds is None else results.add_round
        add(stage.name, values, measured)


def _run(
    tasks: list[Task], store: BlobStore, clock: Callable[[], float], shared: Collection[str]
) -> tuple[list[dict[str, Any]], list[Measured]]:
    values, measured = [], []
    for task in tasks:
        module, name = task.function.split(":")
        function = getattr(importlib.import_module(module), name)
        given = json.dumps(task.args)
        began = clock()
        key = store.url, task.function, given
        left, before = _left.get(key, (None, 0.0)) if task.function in shared else (None, 0.0)
        if left is None:
            with store.scratch() as scratch:
                value = function(
                    json.loads(given),
                    TaskContext(store, scratch, lambda _: None, settings_at=task.settings_at),
                )
            # as a worker's child sends it: NaN and infinity are no JSON
            left = json.dumps(value, allow_nan=False)
        seconds = clock() - began
        if task.function in shared:
            _left.setdefault(key, (left, 0.0 if task.function == SHARED else seconds))
        values.append(json.loads(left))
        measured.append(Measured(seconds + before, 1))
    return values, measured


def registered(store: BlobStore, kind: str, **registration: Any) -> dict[str, Any]:
    """Register a resource; returns what was understood and its canonical digest."""
    request = {"resource_kind": kind, "registration": registration}
    return run_stages(register.stages(request, {}), store, shared=PARSED)["parse"][0]
