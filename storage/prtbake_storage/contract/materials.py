"""What a surface is made of, as requests say it."""

from collections.abc import Iterable, Sequence
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, StringConstraints, model_validator

from prtbake_storage.contract.base import Digest, Positive, ResourceId, Vec3, Wire
from prtbake_storage.contract.brdf import BrdfSpec
from prtbake_storage.errors import SettingsError

Coefficient = Annotated[float, Field(ge=0.0, le=1e9)]
"""Of scattering or absorption, per millimetre."""

Coefficients = Coefficient | tuple[Coefficient, Coefficient, Coefficient]
"""One for all colours, or three for linear Rec.709."""

MediumName = Literal[
    "apple", "chicken1", "chicken2", "cream", "ketchup", "marble", "potato", "skim_milk", "skin1",
    "skin2", "spectralon", "whole_milk",
]  # fmt: skip
"""Media whose coefficients [Jensen2001]_ measured."""


class Subsurface(Wire):
    """Light that scatters inside: a measured ``medium``, or ``scattering`` and ``absorption``.

    A diffuse surface then sends what the dipole of [Jensen2001]_ lets out of it; the BRDF, which
    must be Lambert, tints that by its albedo.
    """

    mm_per_unit: Positive
    """Millimetres to a unit of the mesh: the coefficients are lengths."""
    medium: MediumName | None = None
    scattering: Coefficients | None = None
    """Reduced scattering coefficient per millimetre."""
    absorption: Coefficients | None = None
    """Per millimetre."""
    eta: Annotated[float, Field(ge=1.0, le=2.5)] | None = None
    """Index of refraction; null is that of the medium, or 1.3."""

    @model_validator(mode="after")
    def _one_source(self) -> "Subsurface":
        given = self.scattering is not None and self.absorption is not None
        some = self.scattering is not None or self.absorption is not None
        if self.medium is not None and (some or self.eta is not None):
            raise ValueError("a medium brings its own coefficients: state it or them, not both")
        if self.medium is None and not given:
            raise ValueError("state a medium, or both scattering and absorption")
        if given and not all(any(pair) for pair in zip(*self.coefficients, strict=True)):
            raise ValueError("scattering and absorption are both zero: light meets nothing")
        return self

    @property
    def coefficients(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Scattering and absorption as stated, with equally many channels; none of a medium."""
        given = [
            value if isinstance(value, tuple) else (value,)
            for value in (self.scattering, self.absorption)
            if value is not None
        ]
        n_channels = max((len(value) for value in given), default=0)
        spread = [value if len(value) == n_channels else value * n_channels for value in given]
        return (spread[0], spread[1]) if len(spread) == 2 else ((), ())


def _has_length(direction: Vec3) -> Vec3:
    if not any(direction):
        raise ValueError("a direction needs a length")
    return direction


Tangents = Literal["horizontal", "uv"] | Annotated[Vec3, AfterValidator(_has_length)]
"""Where tangents point: horizontally, along u of the texture coordinates, or along a direction."""


class Material(Wire):
    """What one group of a mesh's faces is made of."""

    brdf: ResourceId | BrdfSpec
    """The id of a registered one, or its JSON."""
    albedo_texture: Digest | None = None
    """Multiplies the reflectance of a Lambert BRDF."""
    subsurface: Subsurface | None = None
    """Light that scatters inside; the BRDF is then Lambert."""
    vertex_colours: bool = False
    """Multiply the reflectance of a Lambert BRDF by the colours that the mesh's file gives."""
    tangents: Tangents = "horizontal"
    """x of the frames that the BRDF is read in; only anisotropic ones depend on it."""
    two_sided: bool = False
    """Reflects on its back as on its front; the back of a surface with one side is black."""


LAMBERT_ONLY = {
    "albedo_texture": "an albedo texture needs a lambert BRDF: it multiplies the whole reflectance",
    "subsurface": "subsurface scattering needs a lambert BRDF: its albedo tints what leaves the "
    "medium",
    "vertex_colours": "vertex colours need a lambert BRDF: they multiply the whole reflectance",
}
"""Fields of a material that go with a Lambert BRDF alone, and why."""


def require_lambert(model: str | None, field: str, pointer: str) -> None:
    """Refuse a field of a material whose BRDF is of another model.

    Raises
    ------
    SettingsError
        With ``pointer``, that of the material, and the field below it.
    """
    if model != "lambert":
        raise SettingsError(LAMBERT_ONLY[field], pointer=f"{pointer}/{field}")


def refuse_two_sided_medium(two_sided: bool, pointer: str) -> None:
    """Refuse two sides of a material that scatters light inside.

    Raises
    ------
    SettingsError
        With ``pointer``, that of the material, and the field.
    """
    if two_sided:
        raise SettingsError(
            "subsurface scattering needs an inside, which a two-sided surface does not have",
            pointer=f"{pointer}/two_sided",
        )


GroupName = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^[^\x00]*$")]
"""A group of a mesh's faces, as ``understood.groups`` of the registered mesh names it."""

MOST_MATERIALS = 32
"""Every one is a part of its own, with a bake, a compression and textures."""

Materials = Annotated[dict[GroupName, Material], Field(max_length=MOST_MATERIALS)]

NAMES_SHOWN = 20


def material_pointer(name: str, *fields: str) -> str:
    """Return the JSON pointer to a group's material in a request, or to a field of it."""
    step = name.replace("~", "~0").replace("/", "~1")
    return "/".join(["/materials", step, *fields])


def require_groups(names: Iterable[str], groups: Sequence[str]) -> None:
    """Refuse a material for a group that a mesh does not have.

    Raises
    ------
    SettingsError
        Naming the groups that there are.
    """
    for name in names:
        if name in groups:
            continue
        shown = ", ".join(repr(group) for group in groups[:NAMES_SHOWN])
        if len(groups) > NAMES_SHOWN:
            shown += f" and {len(groups) - NAMES_SHOWN} more"
        raise SettingsError(
            f"the mesh has no group of faces {name!r}; "
            + (f"it has: {shown}" if groups else "it has none at all"),
            pointer=material_pointer(name),
        )
