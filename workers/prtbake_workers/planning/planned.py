"""What a plan holds: the parts of a scene, its bounces, and what all of it is expected to cost."""

from dataclasses import asdict, dataclass
from typing import Any

from prtbake_storage.decode.asset import Role
from prtbake_workers.planning.cost import (
    PartCost,
)
from prtbake_workers.planning.decision import Decision
from prtbake_workers.planning.ladder_steps import LadderStep
from prtbake_workers.planning.presets import (
    PartCompression,
)
from prtbake_workers.planning.rates import Rates
from prtbake_workers.planning.seen_pixels import SeenPixels
from prtbake_workers.planning.stage_memory import (
    Lobe,
)
from prtbake_workers.planning.step_errors import Resolution


@dataclass(frozen=True)
class PartPlan:
    """What is done to one part of the scene.

    ``occluders`` lists the parts that may block its light; none means that no ray is traced.
    """

    name: str
    role: Role
    vertex_range: tuple[int, int]
    n_terms: int
    lobe: Lobe
    occluders: tuple[int, ...]
    compression: PartCompression
    tiles: tuple[tuple[int, int], ...]
    cost: PartCost


@dataclass(frozen=True)
class BouncePlan:
    """How light that surfaces send to each other, and that scatters inside them, is simulated.

    ``blocks`` are the runs of coefficients that tasks take; ``n_channels`` is 3 where each colour
    has bounces of its own, as ``coloured`` says, or a medium has colours.  ``n_rays`` are those of
    a vertex, part by part, in the first bounce and ``later_rays`` in those after it, at most: fewer
    where one bounce by them is measured to err by less than ``noise_tolerance`` of direct light.
    Parts in ``scattering`` scatter light inside, their clusters within ``solid_angles`` steradians
    each; ``max_bounces`` is 0 where that is all there is.
    """

    n_channels: int
    coloured: bool
    n_rays: tuple[int, ...]
    later_rays: tuple[int, ...]
    noise_tolerance: float
    max_bounces: int
    tolerance: float
    scattering: tuple[int, ...]
    solid_angles: tuple[float, ...]
    blocks: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Plan:
    """All that was decided before the first ray of the bake.

    ``work`` of a stage are the amounts of it, see `stage_work`; ``seen`` what each camera of the
    validation shows; ``memory_bytes`` of a stage those of its largest process, where they are
    predicted.  The environment is taken to have `DEFAULT_TEXELS`: no bake depends on it.
    """

    parts: tuple[PartPlan, ...]
    effects: tuple[Decision, ...]
    bounces: BouncePlan | None
    work: dict[str, dict[str, float]]
    seen: tuple[SeenPixels, ...]
    artefact_bytes: dict[str, int]
    memory_bytes: dict[str, int]
    notes: tuple[str, ...]
    ladder: tuple[LadderStep, ...] = ()
    """Of an asset, the qualities beside its own."""
    resolution: Resolution | None = None
    """What decides the lines of its error budget."""

    @property
    def peak_memory_bytes(self) -> int:
        """Memory of the largest process."""
        return max(self.memory_bytes.values())

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds of every stage by the rates that are shipped: the same on any machine."""
        return Rates().all_seconds(self.work)

    def to_dict(self) -> dict[str, Any]:
        """Give the plan as JSON."""
        return asdict(self)
