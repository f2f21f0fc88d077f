"""Run one task in a process of its own, as a worker does."""

from prtbake_storage.queue.child import run_task_in_child
from prtbake_storage.queue.stages import package_of
from prtbake_workers.jobs.registry import REGISTRY


def run_child(task, store):
    """Give its result and what it cost."""
    with store.scratch() as scratch:
        return run_task_in_child(
            task,
            package=package_of(REGISTRY),
            store_url=store.url,
            scratch=scratch,
            on_message=lambda _: None,
            should_stop=lambda: None,
        )
