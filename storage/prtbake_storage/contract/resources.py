"""Uploads and the typed resources made from them: meshes, BRDFs and environments."""

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from prtbake_storage.contract.base import Digest, Label, Vec3, Wire
from prtbake_storage.contract.brdf import BrdfSpec

ResourceKind = Literal["mesh", "brdf", "environment"]
ResourceState = Literal["parsing", "ready", "refused"]
MeshFormat = Literal["auto", "obj", "ply", "stl", "off", "glb"]
EnvironmentLayout = Literal["auto", "lat_long", "lat_long_exr", "angular_probe", "cube_strip"]


class BuiltinMesh(Wire):
    """A procedural mesh: a sphere, or the teapot of ``tessellation`` quads along a patch edge."""

    name: Literal["teapot", "icosphere"]
    tessellation: Annotated[int, Field(ge=1, le=64)] = 12


class BuiltinEnvironment(Wire):
    """A procedural environment."""

    name: Literal["sun_sky", "hall", "constant", "one_texel_sun"]
    width: Annotated[int, Field(ge=16, le=4096, multiple_of=2)] = 512
    """Pixels along the horizon."""
    sun_elevation_deg: Annotated[float, Field(ge=-10.0, le=90.0)] = 40.0
    sun_azimuth_deg: Annotated[float, Field(ge=-360.0, le=360.0)] = 30.0


class MeshRegistration(Wire):
    """Name a blob (or a procedural mesh) as a mesh, and parse it.

    ``crease_angle_deg``: null keeps the normals that the file gives and computes smooth ones where
    it gives none; a number takes none of the file's, and leaves edges sharp whose face normals
    differ by more than that.
    """

    blob: Digest | None = None
    builtin: BuiltinMesh | None = None
    format: MeshFormat = "auto"
    filename: str | None = Field(default=None, max_length=255)
    orient_outward: bool = True
    crease_angle_deg: Annotated[float, Field(gt=0.0, le=180.0)] | None = None
    label: Label | None = None

    @model_validator(mode="after")
    def _one_source(self) -> "MeshRegistration":
        if (self.blob is None) == (self.builtin is None):
            raise ValueError("give exactly one of blob and builtin")
        return self


class EnvironmentRegistration(Wire):
    """Name a blob (or a procedural sky) as an environment, and parse it."""

    blob: Digest | None = None
    builtin: BuiltinEnvironment | None = None
    layout: EnvironmentLayout = "auto"
    filename: str | None = Field(default=None, max_length=255)
    repair_non_finite: bool = False
    clamp_negative: bool = True
    rotation_deg: Vec3 = (0.0, 0.0, 0.0)
    label: Label | None = None

    @model_validator(mode="after")
    def _one_source(self) -> "EnvironmentRegistration":
        if (self.blob is None) == (self.builtin is None):
            raise ValueError("give exactly one of blob and builtin")
        return self


class BrdfRegistration(Wire):
    """Register a BRDF: JSON in the request, or a file, whose format is told from its bytes."""

    blob: Digest | None = None
    spec: BrdfSpec | None = None
    material: str | None = Field(default=None, max_length=100)
    """Row of a table that holds several."""
    filename: str | None = Field(default=None, max_length=255)
    label: Label | None = None

    @model_validator(mode="after")
    def _one_source(self) -> "BrdfRegistration":
        if (self.blob is None) == (self.spec is None):
            raise ValueError("give exactly one of blob and spec")
        if self.material is not None and self.blob is None:
            raise ValueError("material names a row of a table, which must be a blob")
        return self


class Resource(Wire):
    """A parsed input; ``understood`` says what was found and repaired.

    ``canonical`` names the blob that jobs read: a mesh, an environment or a measured BRDF as
    prtbake HDF5, any other BRDF as canonical JSON.
    """

    id: str
    kind: ResourceKind
    state: ResourceState
    label: str | None = None
    created: datetime
    request: dict[str, Any]
    understood: dict[str, Any] = Field(default_factory=dict)
    canonical: Digest | None = None
    problem: dict[str, Any] | None = None


class ResourcePage(Wire):
    """A page of resources; ``next`` is the cursor of the next one."""

    items: list[Resource]
    next: str | None = None


class MissingRequest(Wire):
    """Digests that a client is about to upload."""

    digests: Annotated[list[Digest], Field(max_length=1000)]


class MissingResponse(Wire):
    """Those of them that the store does not hold."""

    missing: list[Digest]


class Upload(Wire):
    """A stored blob."""

    digest: Digest
    size: int
