"""What the parts of an asset and of a transfer share: material, albedo, factorisation tables."""

from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import CHANNEL_COUNTS, Role, Surface
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.resources import get_colours, put_colours

F32 = NDArray[np.float32]


def put_surface(group: h5py.Group, surface: Surface) -> None:
    """Write a part's name, role, sides, range, material, albedo, factorisation, n_channels."""
    if surface.n_channels not in CHANNEL_COUNTS:
        raise ValueError(f"{surface.name}: n_channels is {surface.n_channels}, not 1 or 3")
    h5.set_attribute(group, "name", surface.name)
    h5.set_attribute(group, "role", surface.role)
    h5.set_attribute(group, "vertex_start", surface.vertex_range[0])
    h5.set_attribute(group, "vertex_stop", surface.vertex_range[1])
    h5.set_attribute(group, "n_channels", surface.n_channels)
    if surface.two_sided:
        h5.set_attribute(group, "two_sided", 1)
    h5.put_json(group, "material", dict(surface.material))
    h5.put(group, "albedo", surface.albedo.astype(np.float32), "channels")
    if surface.albedo_texture is not None:
        texture = surface.albedo_texture.astype(np.float32)
        h5.put(group, "albedo_texture", texture, "height width channels")
    put_colours(group, "vertex_colours", surface.vertex_colours)
    if surface.factorisation is not None:
        put_tables(h5.group(group, "factorisation"), surface.factorisation)


def get_surface(group: h5py.Group) -> dict[str, Any]:
    """Read what `put_surface` wrote, as keyword arguments of `Surface`."""
    start, stop = h5.attribute(group, "vertex_start"), h5.attribute(group, "vertex_stop")
    if not isinstance(start, int) or not isinstance(stop, int) or not 0 <= start < stop:
        raise CorruptArtefact(f"{group.name}: vertex range {start}..{stop} is no range")
    n_channels = h5.attribute(group, "n_channels")
    if not isinstance(n_channels, int) or n_channels not in CHANNEL_COUNTS:
        raise CorruptArtefact(f"{group.name}: n_channels is {n_channels!r}, not 1 or 3")
    name = str(h5.attribute(group, "name"))
    albedo: F32 = h5.get(group, "albedo", "f", (None,)).astype(np.float32)
    if albedo.shape not in {(1,), (3,)}:
        raise CorruptArtefact(f"{group.name}/albedo has shape {albedo.shape}, not (1,) or (3,)")
    texture = None
    if h5.has(group, "albedo_texture"):
        texture = h5.get(group, "albedo_texture", "f", (None, None, 3)).astype(np.float32)
    tables = None
    if h5.has(group, "factorisation"):
        tables = get_tables(h5.child(group, "factorisation"))
    return {
        "name": name,
        "role": _role(group, name),
        "vertex_range": (start, stop),
        "material": h5.get_object(group, "material"),
        "albedo": albedo,
        "albedo_texture": texture,
        "vertex_colours": get_colours(group, "vertex_colours", stop - start),
        "factorisation": tables,
        "n_channels": n_channels,
        "two_sided": _two_sided(group),
    }


def _role(group: h5py.Group, name: str) -> Role:
    """Read the role; files from before there were several parts to an object tell it by name."""
    if not h5.has_attribute(group, "role"):
        return "receiver" if name == "receiver" else "object"
    role = h5.attribute(group, "role")
    if role == "object":
        return "object"
    if role == "receiver":
        return "receiver"
    raise CorruptArtefact(f"{group.name}: role is {role!r}, not 'object' or 'receiver'")


def _two_sided(group: h5py.Group) -> bool:
    """Read the attribute, which parts with one side lack."""
    given = h5.attribute(group, "two_sided") if h5.has_attribute(group, "two_sided") else 0
    if given not in (0, 1):
        raise CorruptArtefact(f"{group.name}: two_sided is {given!r}, not 0 or 1")
    return bool(given)


def put_tables(group: h5py.Group, tables: Mapping[str, Any]) -> None:
    """Write arrays as datasets and plain values as one JSON text."""
    plain = {}
    for name in sorted(tables):
        value = tables[name]
        if isinstance(value, np.ndarray) and value.ndim > 0:
            h5.put(group, name, value, " ".join(f"axis{i}" for i in range(value.ndim)))
        else:
            plain[name] = value.item() if isinstance(value, np.ndarray | np.generic) else value
    h5.put_json(group, "values", plain)


def get_tables(group: h5py.Group) -> dict[str, Any]:
    """Read what `put_tables` wrote."""
    tables = dict(h5.get_object(group, "values"))
    for name in h5.names(group):
        if name != "values":
            tables[name] = h5.get_any(group, name, "fi")
    return tables


def child_parts(file: h5py.File) -> list[h5py.Group]:
    """Return the groups /parts/0, /parts/1, ... in order."""
    parts = h5.child(file, "parts")
    names = h5.names(parts)
    if sorted(names) != sorted(str(i) for i in range(len(names))) or not names:
        raise CorruptArtefact(f"/parts holds {names[:8]}, not 0, 1, ...")
    return [h5.child(parts, str(i)) for i in range(len(names))]
