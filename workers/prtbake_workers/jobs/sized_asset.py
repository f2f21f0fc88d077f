"""An ``asset`` job that is given ``max_bytes`` alone: one quality, compressed to fit into them."""

from dataclasses import replace
from typing import Any

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.queue.stages import Results, Stage, Task
from prtbake_workers.jobs import asset
from prtbake_workers.jobs.search_stages import (
    MADE,
    Tried,
    done,
    refusal,
    refuse_as,
)
from prtbake_workers.jobs.shared_stages import attempted
from prtbake_workers.jobs.work import done_work, rates_of

SIZED = "quantise"
"""The stage that cuts the asset to its bytes."""


class SizedAsset:
    """The one attempt of a job: stages of the main job, of which one may refuse the bytes."""

    def __init__(self, request: dict[str, Any], context: dict[str, Any]) -> None:
        self._context = context
        self._quality = AssetRequest.model_validate(request).planned_quality
        self._stages = asset.stages(request, context)

    def stages(self) -> list[Stage]:
        """List the stages of the main job."""
        at = [stage.name for stage in self._stages].index(SIZED)
        return [
            *self._stages[:at],
            self._refusing(self._stages[at]),
            *(self._after(stage) for stage in self._stages[at + 1 :]),
        ]

    def _refusing(self, stage: Stage) -> Stage:
        def tasks(results: Results) -> list[Task]:
            return [attempted(task) for task in stage.tasks(results)]

        return replace(stage, tasks=tasks)

    def _after(self, stage: Stage) -> Stage:
        return replace(stage, tasks=lambda results: stage.tasks(self.delivered(results)))

    def aim(self, _: Results) -> float | None:
        """Give the error that is aimed at: none is."""
        return None

    def tried(self, _: Results) -> list[Tried]:
        """List the one attempt."""
        why = "has the least error that was found for its bytes"
        return [Tried(f"quality {self._quality}", None, taken=True, why=why, stages=MADE)]

    def is_delivered(self, _name: str, _results: Results) -> bool:
        """Tell whether a stage made something of what is delivered: all do."""
        return True

    def delivered(self, results: Results) -> Results:
        """Give the stages, by the names that they have in other jobs.

        Raises
        ------
        SettingsError
            The bytes are too few; it tells the least.
        """
        if (refused := refusal(results, SIZED)) is not None:
            refuse_as(refused)
        found = Results()
        for name in results:
            measured, recalled = results.measured(name), results.recalled(name)
            found.add(name, done(results[name]), measured, recalled=recalled)
        return found

    def predicted(self, results: Results) -> dict[str, float]:
        """Predict the seconds of the stages, as of any asset."""
        return rates_of(self._context).all_seconds(
            done_work("asset", self.delivered(results), self._context)
        )
