"""Jobs as they go over the wire: requests by kind, state, progress, artefacts, estimates."""

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    FieldSerializationInfo,
    TypeAdapter,
    ValidationInfo,
    field_serializer,
    field_validator,
)

from prtbake_storage.contract.asset_budget import AssetBudget
from prtbake_storage.contract.bake_budget import BakeBudget
from prtbake_storage.contract.base import Digest, Label, ResourceId, Vec3, Wire
from prtbake_storage.contract.brdf import BrdfSpec
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.materials import Materials, Subsurface, Tangents
from prtbake_storage.contract.settings import (
    AssetSettings,
    BakeSettings,
    CompressSettings,
    Effects,
    Quality,
    ReceiverPlane,
    RenderSettings,
    ValidateSettings,
)
from prtbake_storage.contract.study import (
    Axes,
    Axis,
    Values,
    describe,
    first_fault,
    grid,
    laid_over,
)


class JobState(StrEnum):
    """The last four are terminal and closed."""

    queued = "queued"
    running = "running"
    cancel_requested = "cancel_requested"
    succeeded = "succeeded"
    failed = "failed"
    canceled = "canceled"
    expired = "expired"

    @property
    def terminal(self) -> bool:
        """Whether the job will never change again."""
        return self in TERMINAL


TERMINAL = frozenset({JobState.succeeded, JobState.failed, JobState.canceled, JobState.expired})

JobKind = Literal[
    "bake", "compress", "fit_light", "render", "validate", "asset", "study", "calibrate"
]
ArtefactRef = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}/[a-z0-9_.-]{1,100}$")]
"""``JOB/NAME`` of an artefact of an earlier job."""


class _Submission(Wire):
    label: Label | None = None
    priority: Annotated[int, Field(ge=1, le=100)] = 50
    timeout_s: Annotated[int, Field(ge=1, le=7 * 86400)] | None = None


class AddedLight(Wire):
    """A further environment that shines together with the request's own."""

    environment: ResourceId
    scale: Annotated[float, Field(gt=0.0, le=1e6)] = 1.0
    """Of its radiance."""
    rotation_deg: Vec3 = (0.0, 0.0, 0.0)
    """Turns about x, y and z, as at registration; the light is then resampled."""


class _Request(_Submission):
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0


class _OneStage(_Request):
    """A job of one stage, whose settings may begin with those of a quality."""

    quality: Quality | None = None
    """Its settings of the stage stand below those given; null leaves the stage's own defaults."""

    @field_serializer("settings", check_fields=False)
    def _sparse_below_a_quality(
        self, settings: Wire, info: FieldSerializationInfo
    ) -> dict[str, Any]:
        """Keep what was given apart from what was not: defaults would stand in a quality's way.

        Nor could a budget tell them from what it is not to choose.
        """
        chosen = self.quality is not None or getattr(self, "budget", None) is not None
        sparse = bool(info.exclude_unset) or chosen
        return settings.model_dump(mode="json", exclude_unset=sparse)


class _Budgeted(_Request):
    """A job whose budget decides some of its settings."""

    @field_validator("settings", check_fields=False)
    @classmethod
    def _not_the_budgets(cls, settings: Wire, info: ValidationInfo) -> Wire:
        """Refuse settings that would decide what the budget decides."""
        budget = info.data.get("budget")
        if budget is not None:
            budget.check_beside(settings.model_dump(exclude_unset=True))
        return settings


class _SceneRequest(_Request):
    mesh: ResourceId
    brdf: ResourceId | BrdfSpec
    albedo_texture: Digest | None = None
    subsurface: Subsurface | None = None
    """Light that scatters inside the object, whose BRDF is then Lambert."""
    vertex_colours: bool = False
    """Multiply the reflectance of a Lambert BRDF by the colours that the mesh's file gives."""
    tangents: Tangents = "horizontal"
    """x of the frames that the BRDF is read in; only anisotropic ones depend on it."""
    two_sided: bool = False
    """Reflects on its back as on its front; the back of a surface with one side is black."""
    materials: Materials = Field(default_factory=dict)
    """Of groups of the mesh's faces; the others have what stands above."""
    receiver: ReceiverPlane | None = None
    effects: Effects = Effects()


class BakeRequest(_SceneRequest, _OneStage, _Budgeted):
    """Simulate transport: gives ``transfer.h5``."""

    kind: Literal["bake"] = "bake"
    budget: BakeBudget | None = None
    """What it may leave, weigh and take, in place of a quality."""
    settings: BakeSettings = BakeSettings()

    @field_validator("budget")
    @classmethod
    def _one_of_two(cls, budget: BakeBudget | None, info: ValidationInfo) -> BakeBudget | None:
        if budget is not None and info.data.get("quality") is not None:
            raise ValueError("one quality or budget: the budget chooses what a quality would")
        return budget


class CompressRequest(_OneStage):
    """Compress a transfer artefact: gives ``asset.h5``."""

    kind: Literal["compress"] = "compress"
    transfer: ArtefactRef
    settings: CompressSettings = CompressSettings()


class _LitRequest(_Request):
    environment: ResourceId
    lights: Annotated[list[AddedLight], Field(max_length=8)] = Field(default_factory=list)
    """Further environments, added to that one."""


class FitLightRequest(_LitRequest, _OneStage):
    """Fit an environment, or several that shine together: gives ``light.h5``."""

    kind: Literal["fit_light"] = "fit_light"
    settings: FitLightSettings = FitLightSettings()


class RenderRequest(_Request):
    """Relight an asset: gives PNG and EXR pictures."""

    kind: Literal["render"] = "render"
    asset: ArtefactRef
    light: ArtefactRef
    settings: RenderSettings = RenderSettings()


class ValidateRequest(_LitRequest):
    """Hold an asset against the reference: gives pictures, metrics and the error budget."""

    kind: Literal["validate"] = "validate"
    asset: ArtefactRef
    exact: ArtefactRef | None = None
    """The asset in 32 bits; without it compression and quantisation share a line."""
    transfer: ArtefactRef
    light: ArtefactRef
    settings: ValidateSettings = ValidateSettings()


class AssetRequest(_SceneRequest, _LitRequest, _Budgeted):
    """The main job: bake, compress, fit, render, validate, report."""

    kind: Literal["asset"] = "asset"
    budget: AssetBudget | None = None
    """What it may err by and take, in place of a quality; bytes alone may stand beside one."""
    quality: Quality | None = Field(default=None, validate_default=True)
    """Null is `medium`, or what the budget finds."""
    settings: AssetSettings = AssetSettings()

    @field_validator("quality")
    @classmethod
    def _one_of_two(cls, quality: Quality | None, info: ValidationInfo) -> Quality | None:
        if "budget" not in info.data:  # refused itself
            return quality
        budget = info.data["budget"]
        if budget is None or not budget.searched:
            return quality or "medium"
        if quality is not None:
            raise ValueError("one quality or budget: the budget chooses the quality")
        return None

    @property
    def planned_quality(self) -> Quality:
        """The quality that is asked for; with a budget the one that its search starts from."""
        return self.quality or "draft"

    @property
    def planned_settings(self) -> AssetSettings:
        """The overrides, those that the budget decides among them."""
        return self.settings if self.budget is None else self.budget.laid_over(self.settings)


Studied = BakeRequest | CompressRequest | FitLightRequest | AssetRequest
"""Jobs that leave a file of some size with an error of its own."""
StudiedRequest = Annotated[Studied, Field(discriminator="kind")]
_studied: TypeAdapter[Studied] = TypeAdapter(StudiedRequest)


@dataclass(frozen=True)
class StudyPoint:
    """A combination of the axes' values: the request that it makes, or why it makes none."""

    index: int
    values: Values
    request: Studied | None
    refused: str | None


class StudyRequest(_Submission):
    """Run a request at every combination of some values: gives error against seconds and bytes.

    ``axes`` are laid over ``base``, whose label, priority and timeout are not looked at.  Work that
    points have in common is done once.  Combinations that make no legal request are refused, or
    with ``skip_illegal`` left out and listed.
    """

    kind: Literal["study"] = "study"
    base: StudiedRequest
    """The request at the values that no axis changes."""
    skip_illegal: bool = False
    """Leave out points whose values do not go together."""
    axes: Axes
    """Paths into the base and the values there: `{"settings.n_clusters": [16, 32]}`, or a list."""

    @field_serializer("base")
    def _sparse(self, base: Studied, info: FieldSerializationInfo) -> dict[str, Any]:
        if info.exclude_unset:
            return base.model_dump(mode="json", exclude_unset=True)
        return _as_given(base)

    @field_validator("axes")
    @classmethod
    def _legal(cls, axes: list[Axis], info: ValidationInfo) -> list[Axis]:
        """Refuse here, at submission, what a point's own submission would refuse."""
        if "base" not in info.data:  # refused itself
            return axes
        points = _points(info.data["base"], axes)
        refused = [point for point in points if point.refused is not None]
        if refused and (len(refused) == len(points) or not info.data.get("skip_illegal")):
            (first, *_) = refused
            raise ValueError(
                f"{len(refused)} of {len(points)} points are illegal, as the one of "
                f"{describe(first.values)}: {first.refused}"
            )
        return axes

    def points(self) -> list[StudyPoint]:
        """List all points, the illegal ones too, in the order of `grid`."""
        return _points(self.base, self.axes)


def _as_given(base: Studied) -> dict[str, Any]:
    """Write a request with no more settings than it was given.

    Some settle the defaults of others: spelled out, these would stand in an axis's way.
    """
    given = base.settings.model_dump(mode="json", exclude_unset=True)
    return base.model_dump(mode="json", exclude={"settings"}) | {"settings": given}


NO_BUDGETS = "a study shows what accuracy costs, and searches no budget: give a quality"


def _points(base: Studied, axes: list[Axis]) -> list[StudyPoint]:
    points = []
    given = _as_given(base)
    for index, values in enumerate(grid(axes)):
        try:
            request = _studied.validate_python(laid_over(given, values))
        except ValueError as error:
            points.append(StudyPoint(index, values, None, first_fault(error)))
            continue
        if getattr(request, "budget", None) is not None:
            points.append(StudyPoint(index, values, None, NO_BUDGETS))
        else:
            points.append(StudyPoint(index, values, request, None))
    return points


class CalibrateRequest(_Request):
    """Measure what work takes on this machine, for estimates: gives rates, and no file."""

    kind: Literal["calibrate"] = "calibrate"


AnyRequest = (
    BakeRequest
    | CompressRequest
    | FitLightRequest
    | RenderRequest
    | ValidateRequest
    | AssetRequest
    | StudyRequest
    | CalibrateRequest
)
JobRequest = Annotated[AnyRequest, Field(discriminator="kind")]
job_request_adapter: TypeAdapter[AnyRequest] = TypeAdapter(JobRequest)


class Progress(Wire):
    """Where a job stands; ``fraction`` never falls."""

    stage: str = ""
    stage_index: int = 0
    stage_count: int = 0
    fraction: float = 0.0
    done: float = 0
    total: float = 0
    unit: str = ""
    elapsed_s: float = 0.0
    eta_s: float | None = None


class JobError(Wire):
    """Why a job failed: ``input`` the caller mends, ``resource`` the operator, ``internal`` us."""

    kind: Literal["input", "resource", "internal"]
    code: str
    detail: str
    pointer: str | None = None


class Artefact(Wire):
    """One file of a finished job."""

    name: str
    size: int
    media_type: str
    sha256: Digest


class ArtefactManifest(Wire):
    """The files of a job."""

    items: list[Artefact]


class Job(Wire):
    """A job as the API shows it."""

    id: str
    kind: str
    state: JobState
    request: dict[str, Any]
    label: str | None = None
    created: datetime
    started: datetime | None = None
    finished: datetime | None = None
    progress: Progress = Progress()
    error: JobError | None = None
    retry_of: str | None = None
    result: dict[str, Any] | None = None
    artefacts: list[Artefact] = Field(default_factory=list)


class JobPage(Wire):
    """A page of jobs; ``next`` is the cursor of the next one."""

    items: list[Job]
    next: str | None = None


class Estimate(Wire):
    """What a job would do and cost, without running it; None stands for what is not predicted.

    ``seconds`` are those of each stage's tasks, added up; ``total_seconds`` is how long the job
    would last on the workers that live now, if it had them for itself.  Both go by the rates of the
    last calibration (``prtbake calibrate``) or those that are shipped, and by what later jobs took.
    ``artefact_bytes`` are predicted; pictures and reports go by what they show, and have a bound in
    ``artefact_bytes_at_most``.
    """

    plan: dict[str, Any]
    seconds: dict[str, float]
    total_seconds: float | None
    artefact_bytes: dict[str, int]
    artefact_bytes_at_most: dict[str, int] = Field(default_factory=dict)
    peak_memory_bytes: int | None
    errors: dict[str, float]
    warnings: list[str] = Field(default_factory=list)

    @field_validator("seconds")
    @classmethod
    def _not_negative(cls, seconds: dict[str, float]) -> dict[str, float]:
        if any(value < 0 for value in seconds.values()):
            raise ValueError("seconds cannot be negative")
        return seconds


class Event(Wire):
    """One entry of a job's history, as server-sent events replay it."""

    id: int
    job: str
    type: Literal["state", "progress", "log"]
    data: dict[str, Any]
    created: datetime


class Problem(Wire):
    """RFC 9457 problem details with a stable ``code`` and a JSON pointer to the field."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str
    code: str
    pointer: str | None = None
    errors: list[dict[str, Any]] = Field(default_factory=list)
