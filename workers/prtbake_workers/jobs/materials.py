"""The parts of a scene before it is planned: triangles, and what they are made of."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from prtbake_storage.blobs.base import BlobStore
from prtbake_storage.contract.brdf import LambertSpec
from prtbake_storage.contract.materials import (
    Material,
    Tangents,
    material_pointer,
    refuse_two_sided_medium,
    require_groups,
    require_lambert,
)
from prtbake_storage.contract.settings import ReceiverPlane
from prtbake_storage.decode.asset import Role
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32
from prtbake_workers.geometry.face_groups import LONGEST_NAME, distinct_names
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.receiver import receiver_plane
from prtbake_workers.geometry.sides import both_sides
from prtbake_workers.geometry.splitting import split_mesh
from prtbake_workers.jobs.inputs import load_texture

OBJECT, RECEIVER = "object", "receiver"
"""Names of the parts that a scene of one material has."""

NAMED_GROUPS = 3
"""So many groups name a part; of more it has the first and how many they are."""


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
    two_sided
        Whether the mesh is one turned over in its place, see `both_sides`.
    """

    name: str
    role: Role
    mesh: Mesh
    brdf: dict[str, Any]
    albedo_texture: F32 | None = None
    subsurface: dict[str, Any] | None = None
    vertex_colours: F32 | None = None
    tangents: Tangents = "horizontal"
    two_sided: bool = False


def part_inputs(args: dict[str, Any], mesh: Mesh, store: BlobStore) -> list[PartInput]:
    """Make the parts that a plan's arguments describe: those of the object, then its receiver.

    Groups of faces of one material are one part, named after them; an object of one material is
    one part named ``object``.

    Raises
    ------
    SettingsError
        A material for a group that the mesh lacks; an albedo texture, vertex colours or a medium
        that nothing can be done with; tangents along texture coordinates that are not there; a
        medium between two sides.
    """
    require_groups(args["materials"], mesh.group_names)
    # what the request says of the whole object has the same fields at its top level
    default = _material(args)
    by_group = [
        _material(args["materials"][name]) if name in args["materials"] else default
        for name in mesh.group_names
    ] or [default]
    keys = [json.dumps(material, sort_keys=True) for material in by_group]
    distinct = list(dict.fromkeys(keys))
    part_of_group = np.array([distinct.index(key) for key in keys])
    meshes = [mesh]
    if mesh.face_groups is not None and len(distinct) > 1:
        meshes = split_mesh(mesh, part_of_group[mesh.face_groups])
    names = [OBJECT]
    if len(meshes) > 1:
        groups = [
            [group for group, key in zip(mesh.group_names, keys, strict=True) if key == own]
            for own in distinct
        ]
        names = part_names(groups)
    parts = []
    for name, key, own in zip(names, distinct, meshes, strict=True):
        material = by_group[keys.index(key)]
        pointer = ""
        if material is not default:
            pointer = material_pointer(mesh.group_names[keys.index(key)])
        parts.append(_object_part(name, own, material, pointer, store))
    if args["receiver"] is not None:
        parts.append(_receiver(ReceiverPlane.model_validate(args["receiver"]), mesh, store))
    return parts


def _material(given: Mapping[str, Any]) -> dict[str, Any]:
    """Take the fields of `Material`, with their defaults where they are not given."""
    return {name: given.get(name, field.default) for name, field in Material.model_fields.items()}


def _object_part(
    name: str, mesh: Mesh, material: Mapping[str, Any], pointer: str, store: BlobStore
) -> PartInput:
    """Make a part of the object; errors point to fields below ``pointer``."""
    brdf = material["brdf"]
    if material["vertex_colours"]:
        require_lambert(brdf["model"], "vertex_colours", pointer)
        if mesh.colours is None:
            raise SettingsError(
                "the mesh has no usable vertex colours", pointer=f"{pointer}/vertex_colours"
            )
    if material["subsurface"] is not None:
        require_lambert(brdf["model"], "subsurface", pointer)
        refuse_two_sided_medium(material["two_sided"], pointer)
    if material["two_sided"]:
        mesh = both_sides(mesh)
    return PartInput(
        name,
        "object",
        mesh,
        brdf,
        albedo_texture=_texture(material, pointer, mesh, store),
        subsurface=material["subsurface"],
        vertex_colours=mesh.colours if material["vertex_colours"] else None,
        tangents=tangents_of(
            material["tangents"], has_uv=mesh.uv is not None, pointer=f"{pointer}/tangents"
        ),
        two_sided=material["two_sided"],
    )


def part_names(groups: Sequence[Sequence[str]]) -> list[str]:
    """Name parts after their groups, so that no two are called alike."""
    names = []
    for own in groups:
        more = len(own) - 1
        name = ", ".join(own) if len(own) <= NAMED_GROUPS else f"{own[0]} and {more} more"
        if len(name) > LONGEST_NAME:
            ending = f" and {more} more" if more else ""
            name = own[0][: LONGEST_NAME - len(ending)] + ending
        names.append(name)
    return distinct_names(names, taken=[RECEIVER])


def _receiver(receiver: ReceiverPlane, mesh: Mesh, store: BlobStore) -> PartInput:
    plane = receiver_plane(
        mesh.bounds,
        resolution=receiver.resolution,
        extent=receiver.extent,
        gap=receiver.gap,
        texture_repeats=receiver.texture_repeats,
    )
    brdf = (receiver.brdf or LambertSpec(albedo=receiver.albedo)).model_dump(mode="json")
    material = {"brdf": brdf, "albedo_texture": receiver.albedo_texture}
    texture = _texture(material, "/receiver", plane, store)
    # horizontal everywhere: the plane is all pole
    return PartInput(RECEIVER, "receiver", plane, brdf, texture, tangents=(1.0, 0.0, 0.0))


def tangents_of(given: str | list[float], *, has_uv: bool, pointer: str) -> Tangents:
    """Read tangents as a plan's arguments hold them, and refuse what a mesh cannot have."""
    tangents: Tangents = TypeAdapter(Tangents).validate_python(given)
    if tangents == "uv" and not has_uv:
        raise SettingsError(
            "tangents along u need texture coordinates, which the mesh lacks", pointer=pointer
        )
    return tangents


def _texture(material: Mapping[str, Any], pointer: str, mesh: Mesh, store: BlobStore) -> F32 | None:
    if material["albedo_texture"] is None:
        return None
    require_lambert(material["brdf"]["model"], "albedo_texture", pointer)
    pointer = f"{pointer}/albedo_texture"
    if mesh.uv is None:
        raise SettingsError(
            "an albedo texture needs texture coordinates, which the mesh lacks", pointer=pointer
        )
    return load_texture(store, material["albedo_texture"], pointer=pointer)
