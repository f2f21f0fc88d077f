"""The attempts of a search for an error: what there is to try, and where a search stands."""

from dataclasses import dataclass, field
from typing import Any

from prtbake_storage.contract.jobs import AssetRequest
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import Quality
from prtbake_storage.queue.stages import Results
from prtbake_workers.jobs.search_stages import Tried, done, numbered
from prtbake_workers.planning.error_search import MOST_COMPRESSIONS, Compression, Pooled
from prtbake_workers.planning.ladder_steps import legal_steps
from prtbake_workers.planning.presets import StageSettings


@dataclass(frozen=True)
class Rung:
    """A step of the ladder, and its light among those that differ."""

    quality: Quality
    settings: StageSettings
    light: int


MENDED = MOST_COMPRESSIONS
"""Number of the compression that is made where held-out views err by too much."""

BY_BYTES, FINER = MENDED + 1, MENDED + 2
"""Of the one that is made of all bytes, where those of an error take more; and of another like it,
of a finer bake."""

Asked = dict[str, Any]
"""Setting of a compression: its `max_error`, or `max_bytes`."""


@dataclass
class Trail:
    """Where a search stands: what it tried, what is under way, what it has settled on."""

    rungs: list[int] = field(default_factory=list)
    """Of the attempts at the bake, the one under way too."""
    transfers: list[Pooled] = field(default_factory=list)
    lights: list[int] = field(default_factory=list)
    """Steps of the light that were fitted on the last bake, the one under way too."""
    lit: list[Pooled] = field(default_factory=list)
    lines: dict[str, float] = field(default_factory=dict)
    predictions: list[float] = field(default_factory=list)
    """Of the stored transfer at every step, by the first one's ``lines``."""
    asked: dict[int, Asked] = field(default_factory=dict)
    """Of the compressions, by their number; the last is under way, or was."""
    compressed: list[Compression] = field(default_factory=list)
    """For an error, in the order of their trial, and the ``sizes`` of their files in bytes."""
    sizes: list[int | None] = field(default_factory=list)
    finer: int | None = None
    """Step of the bake that is made once more, where bytes bind."""
    aim: float = 0.0
    stage: str = "bake"
    """bake, light, compress, finer, validate, mend or done: what is under way."""
    delivered: int | None = None
    """The compression that is delivered."""
    tried: list[Tried] = field(default_factory=list)
    """Every attempt, and why it was taken or left."""

    @property
    def rung(self) -> int:
        """Step of the bake that the compression under way is of."""
        return self.rungs[-1] if self.finer is None else self.finer


def size_of(results: Results, compression: int) -> int | None:
    """Give the bytes of a compression's file; None where there is none."""
    made = done(results.get(numbered("quantise", compression), []))
    return made[0].get("bytes") if made else None


def ladder_of(request: AssetRequest) -> tuple[list[Rung], list[FitLightSettings]]:
    """Resolve the ladder with a request's overrides: bakes and lights that differ, lowest first.

    Raises
    ------
    SettingsError
        The overrides are legal at no step.
    """
    rungs: list[Rung] = []
    lights: list[FitLightSettings] = []
    for quality, settings in legal_steps(request.settings):
        if settings.fit_light not in lights:
            lights.append(settings.fit_light)
        if all(settings.bake != other.settings.bake for other in rungs):
            rungs.append(Rung(quality, settings, lights.index(settings.fit_light)))
    return rungs, lights
