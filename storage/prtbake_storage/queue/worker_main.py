"""The command of a worker: ``python -m prtbake_storage.queue.worker_main``.

The job kinds come from ``--registry module:attribute``; everything else from ``PRTBAKE_*``
(`QueueSettings`).  ``--workers N`` starts N worker processes and keeps them running.
"""

import argparse
import ctypes
import importlib
import os
import signal
import sys
import threading
from typing import cast

from prtbake_storage.queue.logs import configure_logging
from prtbake_storage.queue.privacy import forbid_reading
from prtbake_storage.queue.settings import REGISTRY, QueueSettings, new_executor_id
from prtbake_storage.queue.stages import JobRunner

_PR_SET_PDEATHSIG = 1


def main(arguments: list[str] | None = None) -> None:
    """Run one worker in this process, or supervise several."""
    parser = argparse.ArgumentParser(prog="prtbake-worker", description=__doc__)
    parser.add_argument("--registry", default=REGISTRY, help="module:attribute of the job kinds")
    parser.add_argument("--executor-id", default=None, help="this process's name, new each start")
    parser.add_argument("--workers", type=int, default=None, help="supervise so many workers")
    parser.add_argument(
        "--parent", type=int, default=None, help="process whose death ends this worker"
    )
    options = parser.parse_args(arguments)
    forbid_reading()
    settings = QueueSettings()
    if options.workers is not None:
        _supervise(options.workers, settings, options.registry)
        return
    executor_id = options.executor_id or new_executor_id()
    configure_logging(worker=executor_id)
    if options.parent is not None:
        _die_with(options.parent)
    runner = load_registry(options.registry)
    from prtbake_storage.queue.worker import run_worker  # the engine takes a second to import

    run_worker(settings, runner, executor_id=executor_id)


def load_registry(path: str) -> JobRunner:
    """Import the job kinds that ``module:attribute`` names."""
    module, _, attribute = path.partition(":")
    return cast(JobRunner, getattr(importlib.import_module(module), attribute))


def _supervise(count: int, settings: QueueSettings, registry: str) -> None:
    from prtbake_storage.queue.supervisor import Supervisor

    configure_logging(worker="supervisor")
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: stop.set())
    with Supervisor(count, settings, registry=registry) as supervisor:
        while not stop.wait(1.0):
            if supervisor.failed:
                sys.exit(1)  # whoever started us shall know, and start us again


def _die_with(parent: int) -> None:
    """Leave in good order when the supervisor dies, however it does."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        sys.exit(0)  # it died before we asked to be told


if __name__ == "__main__":
    main()
