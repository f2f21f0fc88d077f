"""The parts of a scene before it is planned: triangles, and what they are made of."""

from dataclasses import dataclass
from typing import Any, Literal

from pydantic import TypeAdapter

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.brdf import LambertSpec
from prtbake_storage.contract.materials import Tangents
from prtbake_storage.contract.settings import ReceiverPlane
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.receiver import receiver_plane
from prtbake_workers.jobs.inputs import load_texture


@dataclass(frozen=True, eq=False)
class PartInput:
    """One part.

    Attributes
    ----------
    role
        Parts of the object shadow each other as one shape; the receiver is what it stands on.
    brdf
        Stored spec, see `load_brdf`.
    albedo_texture
        Linear, (height, width, 3); None for none.
    subsurface
        What scatters inside, a `Subsurface` as JSON; None for nothing.
    vertex_colours
        Linear, (verts, 3), where they are asked for; None for none.
    tangents
        Where those of an anisotropic BRDF point.
    """

    name: str
    role: Literal["object", "receiver"]
    mesh: Mesh
    brdf: dict[str, Any]
    albedo_texture: F32 | None = None
    subsurface: dict[str, Any] | None = None
    vertex_colours: F32 | None = None
    tangents: Tangents = "horizontal"


def part_inputs(args: dict[str, Any], mesh: Mesh, store: BlobStore) -> list[PartInput]:
    """Make the parts that a plan's arguments describe: the object, then its receiver.

    Raises
    ------
    SettingsError
        An albedo texture, vertex colours or a medium that nothing can be done with, or tangents
        along texture coordinates that are not there.
    """
    texture = None
    if args["albedo_texture"] is not None:
        _check_texture(args["brdf"], mesh.uv is not None)
        texture = load_texture(store, args["albedo_texture"])
    colours = None
    if args["vertex_colours"]:
        _check_colours(args["brdf"], has_colours=mesh.colours is not None)
        colours = mesh.colours
    if args["subsurface"] is not None and args["brdf"]["model"] != "lambert":
        raise SettingsError(
            "subsurface scattering needs a lambert BRDF: its albedo tints what leaves the medium",
            pointer="/subsurface",
        )
    tangents = tangents_of(args["tangents"], has_uv=mesh.uv is not None, pointer="/tangents")
    parts = [
        PartInput(
            "object",
            "object",
            mesh,
            args["brdf"],
            albedo_texture=texture,
            subsurface=args["subsurface"],
            vertex_colours=colours,
            tangents=tangents,
        )
    ]
    if args["receiver"] is not None:
        receiver = ReceiverPlane.model_validate(args["receiver"])
        plane = receiver_plane(
            mesh.bounds,
            resolution=receiver.resolution,
            extent=receiver.extent,
            gap=receiver.gap,
        )
        material = receiver.brdf or LambertSpec(albedo=receiver.albedo)
        spec = material.model_dump(mode="json")
        # horizontal everywhere: the plane is all pole
        parts.append(PartInput("receiver", "receiver", plane, spec, tangents=(1.0, 0.0, 0.0)))
    return parts


def tangents_of(given: str | list[float], *, has_uv: bool, pointer: str) -> Tangents:
    """Read tangents as a plan's arguments hold them, and refuse what a mesh cannot have."""
    tangents: Tangents = TypeAdapter(Tangents).validate_python(given)
    if tangents == "uv" and not has_uv:
        raise SettingsError(
            "tangents along u need texture coordinates, which the mesh lacks", pointer=pointer
        )
    return tangents


def _check_texture(spec: dict[str, Any], has_uv: bool) -> None:
    if spec["model"] != "lambert":
        raise SettingsError(
            "an albedo texture needs a lambert BRDF: it multiplies the whole reflectance",
            pointer="/albedo_texture",
        )
    if not has_uv:
        raise SettingsError(
            "an albedo texture needs texture coordinates, which the mesh lacks",
            pointer="/albedo_texture",
        )


def _check_colours(spec: dict[str, Any], *, has_colours: bool) -> None:
    if spec["model"] != "lambert":
        raise SettingsError(
            "vertex colours need a lambert BRDF: they multiply the whole reflectance",
            pointer="/vertex_colours",
        )
    if not has_colours:
        raise SettingsError("the mesh has no usable vertex colours", pointer="/vertex_colours")
