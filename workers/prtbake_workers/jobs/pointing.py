"""Errors of tasks that point at the fields of the request, whatever its kind has them below."""

from collections.abc import Callable
from functools import wraps
from typing import Any

from prtbake_storage.contract.base import Wire
from prtbake_storage.errors import SettingsError
from prtbake_storage.queue.context import TaskContext

TaskFunction = Callable[[dict[str, Any], TaskContext], dict[str, Any]]


def pointing_at(settings: type[Wire]) -> Callable[[TaskFunction], TaskFunction]:
    """Make a task point at its settings where the job's request has them.

    What raises knows the field by its name only: one job has ``/settings/max_bytes``, where another
    has ``/settings/compress/max_bytes``.  Pointers at what is no field stay.
    """

    def pointing(function: TaskFunction) -> TaskFunction:
        @wraps(function)
        def task(args: dict[str, Any], context: TaskContext) -> dict[str, Any]:
            try:
                return function(args, context)
            except SettingsError as error:
                field = (error.pointer or "").rpartition("/")[2]
                if field in settings.model_fields:
                    error.pointer = f"{context.settings_at}/{field}"
                raise

        return task

    return pointing
