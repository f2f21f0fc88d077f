"""The accuracy ladder: what ``draft`` to ``reference`` mean, stage by stage.

``medium`` holds the settings of [Tsai2006]_ sections 5.1 and 7 (6 x 32 x 32 directions, 642 SRBFs,
ranks (8, 48, 24)) but for one ray a texel: the paper's 128 x 128 rays a face, merged into 32 x 32
texels, are ``supersample`` 4, which no step holds (``high`` and ``reference`` take 2).  The steps
change directions, centres, terms, ranks and lobes together.  Which error is largest depends on the
scene; that of interpolating between vertices, which no setting here changes, often is.
"""

from dataclasses import dataclass, replace
from math import isqrt
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import Field, ValidationError

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import (
    MOST_CLUSTERS,
    OWNERS,
    AssetSettings,
    BakeSettings,
    CentreCount,
    CompressSettings,
    Quality,
    RenderSettings,
    ValidateSettings,
)
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.planning.fan_out import tasks_a_step
from prtbake_workers.planning.view_rank import view_rank


class PlannedBake(BakeSettings):
    """Settings of a bake whose numbers of directions and functions are no longer open."""

    cube_resolution: Annotated[int, Field(ge=2, le=128)] = 32
    n_centres: CentreCount | None = Field(default=None, validate_default=True)

    @property
    def n_coeffs(self) -> int:
        """Functions of the basis."""
        return int(self.n_centres or 0) if self.sh_order is None else self.sh_order**2


@dataclass(frozen=True)
class StageSettings:
    """Settings of every stage of an ``asset`` job, nothing left open but what the scene decides."""

    bake: BakeSettings
    compress: CompressSettings
    fit_light: FitLightSettings
    render: RenderSettings
    validation: ValidateSettings

    @classmethod
    def for_bake(cls, bake: BakeSettings, quality: Quality | None = None) -> "StageSettings":
        """Lay the settings of a lone bake over those of a quality, and complete them with its rest.

        Without one the bake's stand as they are, and the rest, for predictions, is ``medium``'s.
        """
        rest = resolve_stages(quality or "medium", AssetSettings())
        return replace(rest, bake=below_quality("bake", bake, quality))

    @property
    def planned_bake(self) -> PlannedBake:
        """The bake's settings; a ValidationError where a number is ``auto``."""
        return PlannedBake.model_validate(self.bake.model_dump())

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "StageSettings":
        """Read back what the job's tasks are given as JSON."""
        return cls(
            bake=BakeSettings.model_validate(data["bake"]),
            compress=CompressSettings.model_validate(data["compress"]),
            fit_light=FitLightSettings.model_validate(data["fit_light"]),
            render=RenderSettings.model_validate(data["render"]),
            validation=ValidateSettings.model_validate(data["validation"]),
        )

    def to_dict(self) -> dict[str, Any]:
        """Give the settings of all stages as JSON."""
        return {
            name: getattr(self, name).model_dump(mode="json")
            for name in ("bake", "compress", "fit_light", "render", "validation")
        }


VIEW_LOSS = 2.0
"""Energy that view columns may leave of a BRDF, over what its terms may."""


PCA_GROWTH = 2.5
"""Components of PCA over those of a cluster's: 20 and 8 in [Sloan2003] figure 10."""


@dataclass(frozen=True)
class Step:
    """One step of the ladder; ``verts_per_cluster`` turns the vertex count into clusters."""

    bake: dict[str, Any]
    compress: dict[str, Any]
    fit_light: dict[str, Any]
    validation: dict[str, Any]
    verts_per_cluster: int
    ranks: tuple[int, int, int]
    n_components: int


LADDER: dict[Quality, Step] = {
    "draft": Step(
        bake={
            "cube_resolution": 16,
            "n_centres": 162,
            "projection_tolerance": 0.05,
            "term_energy_lost": 0.05,
            "bounce_rays": 32,
            "max_bounces": 3,
            "bounce_tolerance": 4e-3,
            "subsurface_tolerance": 4e-3,
        },
        compress={"max_iterations": 4},
        fit_light={"n_lobes": 32, "max_iterations": 2},
        validation={"width": 128, "height": 96, "passes": 4, "samples": 128},
        verts_per_cluster=720,
        ranks=(4, 16, 8),
        n_components=8,
    ),
    "low": Step(
        bake={
            "cube_resolution": 16,
            "n_centres": 162,
            "projection_tolerance": 0.03,
            "term_energy_lost": 0.02,
            "bounce_rays": 32,
            "max_bounces": 4,
            "bounce_tolerance": 2e-3,
            "subsurface_tolerance": 2e-3,
        },
        compress={"max_iterations": 6},
        fit_light={"n_lobes": 64, "max_iterations": 3},
        validation={"width": 160, "height": 120, "passes": 8, "samples": 128},
        verts_per_cluster=480,
        ranks=(6, 32, 16),
        n_components=12,
    ),
    "medium": Step(
        bake={
            "cube_resolution": 32,
            "n_centres": 642,
            "projection_tolerance": 0.02,
            "term_energy_lost": 0.01,
            "bounce_rays": 64,
            "max_bounces": 6,
            "bounce_tolerance": 1e-3,
            "subsurface_tolerance": 1e-3,
        },
        compress={"max_iterations": 8},
        fit_light={"n_lobes": 162, "max_iterations": 4},
        validation={"width": 192, "height": 144, "passes": 8, "samples": 128},
        verts_per_cluster=360,
        ranks=(8, 48, 24),
        n_components=16,
    ),
    "high": Step(
        bake={
            "cube_resolution": 32,
            "supersample": 2,
            "n_centres": 642,
            "projection_tolerance": 0.015,
            "term_energy_lost": 0.004,
            "bounce_rays": 128,
            "max_bounces": 8,
            "bounce_tolerance": 3e-4,
            "subsurface_tolerance": 3e-4,
        },
        compress={"max_iterations": 12},
        fit_light={"n_lobes": 256, "max_iterations": 6},
        validation={"width": 192, "height": 144, "passes": 16, "samples": 128},
        verts_per_cluster=240,
        ranks=(12, 64, 32),
        n_components=24,
    ),
    "reference": Step(
        bake={
            "cube_resolution": 48,
            "supersample": 2,
            "n_centres": 2562,
            "projection_tolerance": 0.01,
            "term_energy_lost": 0.002,
            "bounce_rays": 256,
            "max_bounces": 12,
            "bounce_tolerance": 1e-4,
            "subsurface_tolerance": 1e-4,
        },
        compress={"max_iterations": 16},
        fit_light={"n_lobes": 400, "max_iterations": 8},
        validation={"width": 256, "height": 192, "passes": 32, "samples": 128},
        verts_per_cluster=180,
        ranks=(16, 96, 48),
        n_components=32,
    ),
}


def resolve_stages(quality: Quality, overrides: AssetSettings) -> StageSettings:
    """Lay the fields a request gives over the quality's step; null leaves them to the step."""
    step = LADDER[quality]
    given = {
        name: value
        for name, value in overrides.bake.items()
        if value is not None or name not in OWNERS
    }
    bake = dict(step.bake)
    if overrides.bake.get("basis") == "sh":
        # the largest order with no more functions than the step has centres
        bake["sh_order"] = isqrt(bake.pop("n_centres"))
    if overrides.bake.get("factorisation") == "sh":
        del bake["term_energy_lost"]
    bake |= given
    if "n_terms" in given and "term_energy_lost" not in overrides.bake:
        bake.pop("term_energy_lost", None)
    return StageSettings(
        bake=BakeSettings.model_validate(bake),
        compress=CompressSettings.model_validate(step.compress | overrides.compress),
        fit_light=_light(step.fit_light, overrides.fit_light),
        render=RenderSettings.model_validate(overrides.render),
        validation=_validation(step.validation | overrides.validation),
    )


Staged = TypeVar("Staged", BakeSettings, CompressSettings, FitLightSettings)


def below_quality(stage: str, settings: Staged, quality: Quality | None) -> Staged:
    """Lay the fields of a request of one stage over a quality's step; None leaves them alone."""
    if quality is None:
        return settings
    given = settings.model_dump(mode="json", exclude_unset=True)
    resolved = resolve_stages(quality, AssetSettings.model_validate({stage: given}))
    found: Staged = getattr(resolved, stage)
    return found


def _light(step: dict[str, Any], overrides: dict[str, Any]) -> FitLightSettings:
    """Lay the fields of a request over those of the step, which are of scattered lobes."""
    given = {name: value for name, value in overrides.items() if value is not None}
    left = dict(step)
    if given.get("method", "srbf_scattered") != "srbf_scattered":
        left = {}
    elif "max_error" in given or "max_bytes" in given:
        del left["n_lobes"]
    return FitLightSettings.model_validate(left | given)


def _validation(fields: dict[str, Any]) -> ValidateSettings:
    """Check the whole: fields that are legal by themselves may ask too much of a quality's rest."""
    try:
        return ValidateSettings.model_validate(fields)
    except ValidationError as error:
        (first, *_) = error.errors()
        where = "/".join(map(str, first["loc"]))
        raise SettingsError(first["msg"], pointer=f"/settings/validation/{where}") from error


@dataclass(frozen=True)
class PartCompression:
    """How one part is compressed; each method reads the sizes that it has a use for.

    ``tasks`` share each step of a tensor approximation; they change nothing that is made.
    """

    method: str
    n_clusters: int
    ranks: tuple[int, int, int]
    n_components: int
    classification: str = "static"
    tasks: int = 1

    @property
    def rank(self) -> int:
        """Weights of a vertex."""
        return self.ranks[2] if self.method == "cta" else self.n_components

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> "PartCompression":
        """Read back what the job's tasks are given as JSON."""
        return cls(**data | {"ranks": tuple(data["ranks"])})


def resolve_compression(
    settings: CompressSettings,
    quality: Quality,
    *,
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    n_channels: int = 1,
    singular_values: Float64[F64, " values"] | None = None,
) -> PartCompression:
    """Choose method, clusters and ranks of a part from its size, unless the request gives them.

    One term means clustered PCA, more mean clustered tensor approximation ([Tsai2006] 5.2).
    Ranks and cluster counts are cut to what the data can hold.  Three colour channels share weights
    and clusters; the view rank is that of each.  Given the BRDF's singular values, the view rank
    grows beyond the ladder's until it leaves `VIEW_LOSS` times what the terms may leave, and the
    other two by the square root of as much.

    Vector quantisation keeps as many means as clustered PCA would keep means and components, and
    PCA `PCA_GROWTH` times the components: pictures then cost about as much ([Sloan2003] figure 10).
    """
    step = LADDER[quality]
    method = settings.method if settings.method != "auto" else ("cpca" if n_terms == 1 else "cta")
    n_clusters = settings.n_clusters or max(1, round(n_verts / step.verts_per_cluster))
    n_components = settings.n_components or step.n_components
    if method == "vq":
        if settings.n_clusters is None:
            n_clusters = min(n_clusters * (1 + n_components), MOST_CLUSTERS)
        n_components = 0
    elif method == "pca":
        n_clusters = 1
        if settings.n_components is None:
            n_components = round(PCA_GROWTH * n_components)
    view, light, vert = settings.ranks or step.ranks
    if settings.ranks is None and singular_values is not None:
        view = view_rank(
            view,
            singular_values,
            VIEW_LOSS * step.bake["term_energy_lost"],
            vertex_bytes=4 * n_channels * n_coeffs,
            n_verts=n_verts,
        )
        # what is sharp in view is sharp in light and differs between vertices too
        growth = float(np.sqrt(view / step.ranks[0]))
        light, vert = round(light * growth), round(vert * growth)
    view, n_clusters = min(view, n_terms), min(n_clusters, n_verts)
    # a vertex mixes vert matrices of so many rows: together they span no more
    light = min(light, n_coeffs, n_channels * view * vert)
    tasks = 1
    budgets = settings.max_error, settings.max_bytes, settings.max_seconds
    if method == "cta" and budgets == (None, None, None):
        tasks = (
            settings.step_tasks
            if settings.step_tasks != "auto"
            else tasks_a_step(
                n_verts=n_verts,
                n_rows=n_channels * view,
                n_coeffs=n_coeffs,
                n_clusters=n_clusters,
                light=light,
                vert=vert,
            )
        )
    return PartCompression(
        method=method,
        n_clusters=n_clusters,
        ranks=(view, light, vert),
        n_components=min(n_components, n_channels * n_terms * n_coeffs),
        classification=settings.classification,
        tasks=min(tasks, n_clusters),
    )
