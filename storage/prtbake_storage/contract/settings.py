"""Settings of every stage, with the papers' values as ``medium``-to-``high`` defaults."""

from math import prod
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from prtbake_storage.contract.base import (
    Digest,
    MaxBytes,
    MaxError,
    MaxSeconds,
    Positive,
    Vec3,
    Wire,
)
from prtbake_storage.contract.brdf import BrdfSpec, Reflectance
from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.decode.sh import MOST_ORDER
from prtbake_storage.decode.transfer_basis import BasisKind

Quality = Literal["draft", "low", "medium", "high", "reference"]
Switch = Literal["auto", "on", "off"]
Rank = Annotated[int, Field(ge=1, lt=2**31)]
CentreCount = Literal[12, 42, 162, 642, 2562, 10242]
MOST_CLUSTERS = 4096  # of a part
MOST_CENTRES = 10242
MOST_STEP_TASKS = 4096  # of a part whose steps are shared

FactorisationKind = Literal["svd", "sh"]

OWNERS = {
    "n_centres": ("basis", "srbf"),
    "bandwidth": ("basis", "srbf"),
    "sh_order": ("basis", "sh"),
    "n_terms": ("factorisation", "svd"),
    "term_energy_lost": ("factorisation", "svd"),
    "view_order": ("factorisation", "sh"),
}
"""Settings that go with one kind of basis or factorisation alone."""

SIZES = {"n_centres": 642, "sh_order": 25, "view_order": 5}
"""Of these where a request says nothing and their kind is taken: 642, 625 and 25 functions."""


class Effects(Wire):
    """Which effects to simulate; ``auto`` lets planning decide.

    ``view_dependence`` off bakes the best one term a part, whatever the settings ask: the view then
    scales what a point reflects and chooses nothing of it.  ``colour_bleeding`` gives each colour
    its own bounced light, at three times the coefficients; without it colours share their mean.
    """

    self_shadowing: Switch = "auto"
    """Shadows of the object on itself."""
    receiver_shadows: Switch = "auto"
    """Shadows of the object and the plane on each other."""
    view_dependence: Switch = "auto"
    """Reflection that changes with the view."""
    interreflection: Switch = "auto"
    """Light that bounces between surfaces; `on` takes all of `bounce_rays`."""
    colour_bleeding: Switch = "auto"
    """Bounced light of each colour by itself."""
    subsurface_scattering: Switch = "auto"
    """Light that enters a part with a medium in one place and leaves it in another."""


class ReceiverPlane(Wire):
    """A plane under the object, ``extent`` object diagonals wide.

    It is diffuse, of an ``albedo`` of one number or three, or has a ``brdf`` of its own.  A texture
    lies across it once, upright as seen from above with -z away from the viewer.
    """

    resolution: Annotated[int, Field(ge=2, le=1024)] = 64
    """Vertices along each side."""
    extent: Annotated[float, Field(gt=0.0, le=100.0)] = 2.0
    """Length of a side in diagonals of the object's box."""
    gap: Annotated[float, Field(ge=0.0, le=10.0)] = 0.0
    """Distance below the box in diagonals; 0 lets the object stand on the plane."""
    albedo: Reflectance = 0.7
    """Diffuse reflectance."""
    brdf: BrdfSpec | None = None
    """Takes the place of `albedo`; x of its frames is that of the scene."""
    albedo_texture: Digest | None = None
    """Multiplies the diffuse reflectance."""
    texture_repeats: Annotated[float, Field(gt=0.0, le=1000.0)] = 1.0
    """How often the texture lies across each side."""


class BakeSettings(Wire):
    """Transport: ``cube_resolution`` N is 6 N^2 directions; ``supersample`` S is S^2 rays each.

    It is projected on a ``basis`` of incident light, ``n_centres`` Gaussian SRBFs (``srbf``) or the
    spherical harmonics (``sh``) of ``sh_order`` bands; as many of either leave about as much.
    The views of an isotropic BRDF are one side of the best sum of K products (``factorisation``
    ``svd``), or lie in the hemispherical harmonics of ``view_order`` bands (``sh``): more terms for
    the same error, in functions that no BRDF chooses.  Fields of one kind are refused with the
    other.

    ``bandwidth`` is 60 for 642 centres and in proportion for others; at most ten times that.
    Bounces are traced by ``bounce_rays`` a vertex until one adds less than ``bounce_tolerance`` (a
    squared-error ratio in radiance norm) or ``max_bounces`` are done.  Unless interreflection is
    forced on, fewer rays are taken where the noise of the first bounce is predicted, or that of all
    is measured, to stay below half of the tolerance.  Parts with a medium whose scattering moves no
    more than ``subsurface_tolerance`` of their light reflect it where it falls; in others it is
    moved with an error of about a tenth of that, see the plan's notes where no clusters are so
    small.  Where ``cube_resolution`` or ``n_centres`` is ``auto`` planning
    samples transport at some vertices and takes the fewest that it predicts to leave no more than
    ``projection_tolerance`` of it, of at most 48 and 2562.
    """

    cube_resolution: Annotated[int, Field(ge=2, le=128)] | Literal["auto"] = 32
    """N of 6 N^2 directions that light is simulated in; `auto` leaves it to planning."""
    supersample: Annotated[int, Field(ge=1, le=8)] = 1
    """S of S^2 shadow rays a direction."""
    basis: BasisKind = "srbf"
    """Functions that transport is projected on: spherical radial ones, or spherical harmonics."""
    n_centres: CentreCount | Literal["auto"] | None = Field(default=None, validate_default=True)
    """Functions of basis `srbf`; `auto` leaves it to planning; null is 642, and the quality's in an
    asset job."""
    projection_tolerance: Annotated[float, Field(gt=0.0, lt=1.0)] = 0.02
    """Squared, relative: what a projection that planning chooses may leave of transport."""
    bandwidth: Positive | None = None
    """Of these functions: larger is narrower; null is 60 for 642 centres, and in proportion."""
    sh_order: Annotated[int, Field(ge=1, le=MOST_ORDER)] | None = Field(
        default=None, validate_default=True
    )
    """Bands n of basis `sh`: n² functions; null is 25, and for as many as `n_centres` in an asset
    job."""
    factorisation: FactorisationKind = "svd"
    """How a BRDF becomes a sum of K products: the best such sum, or harmonics of the view."""
    n_terms: Annotated[int, Field(ge=1, le=256)] | None = None
    """Of factorisation `svd`: terms K at most; null lets `term_energy_lost` choose."""
    term_energy_lost: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Of factorisation `svd`: share of the BRDF's energy that its K terms may lose."""
    view_order: Annotated[int, Field(ge=1, le=10)] | None = Field(
        default=None, validate_default=True
    )
    """Bands of factorisation `sh`, on the hemisphere of views: n² functions, or a few less; null is
    5."""
    bounce_rays: Annotated[int, Field(ge=1, le=4096)] = 64
    """Rays a vertex that look for bounced light, at most."""
    max_bounces: Annotated[int, Field(ge=1, le=64)] = 6
    """The last of them, whatever it adds."""
    bounce_tolerance: Annotated[float, Field(ge=0.0, lt=1.0)] = 1e-3
    """Squared, relative: a bounce that adds less is the last, an effect that costs less is left."""
    subsurface_tolerance: Annotated[float, Field(ge=0.0, lt=1.0)] = 1e-3
    """Scattering that moves less than this of a part's light is left out: squared, relative."""
    frame_seed: Annotated[int, Field(ge=0, lt=2**63)] | None = None
    """Turns the tangent frames of isotropic parts at random, which should change nothing."""
    tile_vertices: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Vertices a task; null leaves it to planning."""
    threads: Annotated[int, Field(ge=1, le=64)] = 1
    """Of a task."""

    @property
    def open_numbers(self) -> tuple[str, ...]:
        """Fields that planning is to choose."""
        numbers = {"cube_resolution": self.cube_resolution, "n_centres": self.n_centres}
        return tuple(name for name, value in numbers.items() if value == "auto")

    @field_validator(*OWNERS)
    @classmethod
    def _of_its_kind(cls, value: float | str | None, info: ValidationInfo) -> float | str | None:
        """Refuse what belongs to another kind; settle the size of the kind that is taken."""
        name = str(info.field_name)
        choice, owner = OWNERS[name]
        if choice not in info.data:  # refused itself
            return value
        if info.data[choice] == owner:
            return SIZES.get(name) if value is None else value
        if value is not None:
            raise ValueError(f"{name} is of {choice} {owner!r}, not of {info.data[choice]!r}")
        return None

    @field_validator("basis", "n_centres", "bandwidth")
    @classmethod
    def _known(cls, value: float | str | None, info: ValidationInfo) -> float | str | None:
        """Refuse what planning cannot choose the rest for."""
        resolution_open = info.data.get("cube_resolution") == "auto"
        if info.field_name == "bandwidth":
            if value is not None and info.data.get("n_centres") == "auto":
                raise ValueError("a bandwidth goes with a number of n_centres, not with auto")
        elif value == MOST_CENTRES and resolution_open:
            raise ValueError(f"{MOST_CENTRES} centres need a cube_resolution beside them, of 66")
        elif value == "sh" and resolution_open:
            raise ValueError("basis 'sh' goes with a number of cube_resolution, not with auto")
        return value


class CompressSettings(Wire):
    """Compression; null leaves the choice to planning.  ``ranks`` are (view, light, vert).

    Every ``method`` takes every part: vector quantisation (``vq``), PCA and clustered PCA compress
    the terms and coefficients of a vertex as one signal, clustered tensor approximation (``cta``)
    as a matrix.  Sizes that a method has no use for are left aside.
    """

    method: Literal["auto", "vq", "pca", "cpca", "cta"] = "auto"
    """`auto` is clustered PCA for parts of one term, and tensors for others."""
    n_clusters: Annotated[int, Field(ge=1, le=MOST_CLUSTERS)] | None = None
    """Of each part, but for `pca`; null goes by its vertices and the quality."""
    ranks: tuple[Rank, Rank, Rank] | None = None
    """Of the tensor approximation: view, light, vertex."""
    n_components: Annotated[int, Field(ge=1, le=512)] | None = None
    """Of PCA; of clustered PCA, a cluster."""
    classification: Literal["static", "iterative", "adaptive"] = "static"
    """Of clustered PCA: by distance to the mean, by error, or by error with as many components a
    cluster as pay there, `n_components` in the mean.  `adaptive` gives clusters of tensors ranks of
    their own too, which store no more together than `ranks` of all would."""
    max_iterations: Annotated[int, Field(ge=1, le=200)] = 10
    """Rounds of clustering at most."""
    bits: Literal[8, 16, "auto"] = "auto"
    """Of the factors in the asset file; `auto` takes for each column as few as the error allows."""
    max_quantisation_error: Annotated[float, Field(ge=0.0, lt=1.0)] | None = None
    """Of `auto`: what rounding may add to a part, squared, relative to its transfer; null is a
    hundredth of what compression leaves."""
    max_error: MaxError | None = None
    """Squared, relative to a part's transfer, rounding included: sizes are searched that end just
    below it.  Takes the place of `ranks`, `n_components` and `max_quantisation_error`."""
    max_bytes: MaxBytes | None = None
    """Of `asset.h5`, mesh and tables included: sizes, columns and bits are searched that end just
    below it with the least error.  Takes the place of the same; beside `max_error`, what the fewest
    bytes for that error are held against."""
    max_seconds: MaxSeconds | None = None
    """Of all tasks of compressing and writing, added up: fits end between two of their rounds with
    what they have, and notes say so.  One round is the least that is done, whatever it takes."""
    coherence: Annotated[float, Field(ge=0.0, le=1000.0)] | None = None
    """What a vertex pays for being a box diagonal off its cluster on the mesh, in root mean square
    norms of the signal; null and 0 leave places aside, 0.05 is Chen's.  Where clusters have bases
    (tensors, `iterative` and `adaptive` classification), a vertex moves only if its error falls
    too."""
    overdraw_budget: Annotated[float, Field(ge=0.0, le=10.0)] | None = None
    """Share of the squared error that moving vertices to neighbours' clusters may add where that
    saves draws; null moves none, 0.05 is Sloan's."""
    registers: Annotated[int, Field(ge=1, le=1_000_000)] | None = None
    """Constant registers, of four numbers, of a renderer that the asset holds index buffers for;
    null makes none."""
    threads: Annotated[int, Field(ge=1, le=64)] = 2
    """Of a task."""
    step_tasks: Annotated[int, Field(ge=1, le=64)] | Literal["auto"] = "auto"
    """Tasks that share each step of a tensor approximation, 1 for all of it in one; `auto` goes by
    its size.  The file does not depend on it.  Beside a budget it is one.  Times 2 `max_iterations`
    + 5 steps it is 4096 a part at most."""

    @field_validator("step_tasks")
    @classmethod
    def _few_processes(cls, tasks: int | str, info: ValidationInfo) -> int | str:
        """Refuse more processes than shared steps are worth."""
        iterations = info.data.get("max_iterations")
        if isinstance(tasks, str) or tasks == 1 or iterations is None:
            return tasks
        if (total := tasks * (2 * iterations + 5)) > MOST_STEP_TASKS:
            raise ValueError(
                f"step_tasks {tasks} for max_iterations {iterations} may start {total} tasks a "
                f"part: {MOST_STEP_TASKS} at most"
            )
        return tasks

    @field_validator("max_quantisation_error")
    @classmethod
    def _of_auto(cls, bound: float | None, info: ValidationInfo) -> float | None:
        """Refuse a bound beside a number of bits."""
        if bound is not None and info.data.get("bits", "auto") != "auto":
            raise ValueError("max_quantisation_error goes with bits 'auto', not with a number")
        return bound

    @field_validator("max_error", "max_bytes")
    @classmethod
    def _alone(cls, asked: float | None, info: ValidationInfo) -> float | None:
        """Refuse an error or bytes beside what would decide them."""
        if asked is None:
            return asked
        for name in ("ranks", "n_components", "max_quantisation_error"):
            if info.data.get(name) is not None:
                raise ValueError(f"{info.field_name} chooses {name}: give one of them")
        if info.data.get("bits") == 8:
            raise ValueError(f"{info.field_name} chooses the bits: leave them 'auto', or 16")
        if info.field_name == "max_bytes" and info.data.get("bits") == 16:
            raise ValueError("max_bytes chooses the bits: leave them 'auto'")
        return asked


class Camera(Wire):
    """A pinhole; null for eye and target frames the object, seen from azimuth and elevation."""

    name: str = Field(default="front", pattern=r"^[a-z0-9_-]{1,40}$")
    """Part of the pictures' names."""
    eye: Vec3 | None = None
    """In scene units; null stands so far off that the object fills the picture."""
    target: Vec3 | None = None
    """What it looks at; null is the middle of the object."""
    up: Vec3 = (0.0, 1.0, 0.0)
    fov_deg: Annotated[float, Field(gt=1.0, lt=170.0)] = 35.0
    """Vertical."""
    azimuth_deg: float = 30.0
    """About y, from +z towards +x; for an eye of null."""
    elevation_deg: Annotated[float, Field(gt=-90.0, lt=90.0)] = 20.0
    """Above the horizon; for an eye of null."""


def _distinct(cameras: list[Camera]) -> list[Camera]:
    """Refuse two cameras of one name: their pictures are files of that name."""
    first: dict[str, int] = {}
    for place, camera in enumerate(cameras):
        if (other := first.setdefault(camera.name, place)) != place:
            raise ValueError(f"cameras {other} and {place} are both called {camera.name!r}")
    return cameras


Cameras = Annotated[list[Camera], Field(min_length=1, max_length=16), AfterValidator(_distinct)]


MOST_TURNTABLE_PIXELS = 1 << 29
"""Of all frames together: 360 of 1280 x 960."""

MOST_PASS_PIXELS = 1 << 25
"""Pixels x passes x rotations of a camera: all are held until its budget is made, in 96 bytes."""


class RenderSettings(Wire):
    """Previews: one picture a camera, and ``turntable_frames`` with the light turning."""

    cameras: Cameras = Field(default_factory=lambda: [Camera()])
    width: Annotated[int, Field(ge=16, le=4096)] = 640
    height: Annotated[int, Field(ge=16, le=4096)] = 480
    rotation_deg: Vec3 = (0.0, 0.0, 0.0)
    """Turns the light about x, y and z."""
    turntable_frames: Annotated[int, Field(ge=0, le=360)] = 0
    """Frames of an animation with the light turning; 0 makes none."""
    backend: Literal["auto", "egl", "cpu"] = "auto"
    """OpenGL (`egl`) or `cpu`."""
    exposure: Positive | None = None
    """Factor before the sRGB curve; null takes it from the first picture."""

    @field_validator("turntable_frames")
    @classmethod
    def _bounded(cls, frames: int, info: ValidationInfo) -> int:
        pixels = frames * info.data.get("width", 1) * info.data.get("height", 1)
        if pixels > MOST_TURNTABLE_PIXELS:
            raise ValueError(
                f"width x height x turntable_frames is {pixels}: at most {MOST_TURNTABLE_PIXELS}"
            )
        return frames


REFERENCE_BOUNCES = 8
"""Of the reference where transfer was baked with bounces: later ones bring 0.2 % of the light even
in a closed room of albedo 0.5."""

SAMPLES_PER_PATH = 8
"""Light samples that cost about what a path does."""

MEDIUM_PATHS = 4
"""Paths of a pixel that shows a medium, over those of others: all of its light comes by them."""


class ValidateSettings(Wire):
    """Reference pictures: ``passes`` x ``samples`` light samples give value and variance.

    ``bounces`` of light between surfaces, null for 8 where the transfer was baked with bounces and
    for 0 where it was not; they are estimated from ``passes`` x ``bounce_samples`` paths a pixel,
    null for one in 8 light samples.
    """

    cameras: Cameras = Field(
        default_factory=lambda: [
            Camera(),
            Camera(name="back", azimuth_deg=200.0, elevation_deg=35.0),
        ]
    )
    width: Annotated[int, Field(ge=16, le=2048)] = 192
    height: Annotated[int, Field(ge=16, le=2048)] = 144
    passes: Annotated[int, Field(ge=2, le=256)] = 8
    """Independent estimates of the reference: they tell its noise."""
    samples: Annotated[int, Field(ge=1, le=65536)] = 128
    """Light samples a pixel and pass."""
    rotations_deg: Annotated[list[Vec3], Field(min_length=1, max_length=16)] = Field(
        default_factory=lambda: [(0.0, 0.0, 0.0)]
    )
    """Turns of the light to validate at, about x, y and z."""
    bounces: Annotated[int, Field(ge=0, le=32)] | None = None
    """Of the reference's light between surfaces."""
    bounce_samples: Annotated[int, Field(ge=1, le=65536)] | None = None
    """Paths a pixel and pass."""

    def reference_bounces(self, *, baked: bool) -> int:
        """Return the bounces of the reference, for transfer with or without baked bounces."""
        if self.bounces is not None:
            return self.bounces
        return REFERENCE_BOUNCES if baked else 0

    @property
    def paths(self) -> int:
        """Paths a pixel and pass, where there are bounces."""
        return self.bounce_samples or max(1, self.samples // SAMPLES_PER_PATH)

    @field_validator("passes", "rotations_deg")
    @classmethod
    def _bounded(cls, value: int | list[Vec3], info: ValidationInfo) -> int | list[Vec3]:
        given = info.data
        counts = [given.get("width", 1), given.get("height", 1), given.get("passes", 1)]
        pixels = prod(counts) * (value if isinstance(value, int) else len(value))
        if pixels > MOST_PASS_PIXELS:
            raise ValueError(
                f"width x height x passes x rotations is {pixels}: at most {MOST_PASS_PIXELS}"
            )
        return value


STAGES: dict[str, type[Wire]] = {
    "bake": BakeSettings,
    "compress": CompressSettings,
    "fit_light": FitLightSettings,
    "render": RenderSettings,
    "validation": ValidateSettings,
}
"""Stage of an asset job, as its settings name it -> what may be set there."""


class AssetSettings(Wire):
    """Overrides of a quality's settings, stage by stage: only the fields given differ from it."""

    bake: dict[str, Any] = Field(default_factory=dict)
    compress: dict[str, Any] = Field(default_factory=dict)
    fit_light: dict[str, Any] = Field(default_factory=dict)
    render: dict[str, Any] = Field(default_factory=dict)
    validation: dict[str, Any] = Field(default_factory=dict)

    @field_validator("bake", "compress", "fit_light", "render", "validation")
    @classmethod
    def _legal(cls, fields: dict[str, Any], info: ValidationInfo) -> dict[str, Any]:
        """Refuse here, at submission, what the stage itself would refuse."""
        STAGES[str(info.field_name)].model_validate(fields)
        return fields
