"""Which primitives of a glTF file are one group of faces, and what it is called."""

from collections.abc import Sequence
from typing import Any, NamedTuple


class Primitive(NamedTuple):
    """A primitive that is kept: its mesh, its place among those kept of it, its material."""

    mesh: int
    place: int
    material: Any

    @property
    def trimesh_name(self) -> str:
        """What trimesh calls it, its mesh being called ``mesh0``, ``mesh1``, ..."""
        return f"mesh{self.mesh}_{self.place}" if self.place else f"mesh{self.mesh}"


def group_primitives(
    header: dict[str, Any], primitives: Sequence[Primitive]
) -> tuple[dict[str, int], list[str]]:
    """Group the primitives by material where they have several, else by mesh.

    A mesh without a name has that of the first node that it hangs on.

    Returns
    -------
    groups, names
        Group of each primitive by its name in trimesh, and the names of the groups, as in the
        file.
    """
    materials = {_index(one.material) for one in primitives} - {None}
    by_material = len(materials) > 1
    names_of = _names(header, "materials" if by_material else "meshes")
    if not by_material:
        names_of = _node_names(header) | names_of
    word = "material" if by_material else "mesh"
    numbers: dict[int | None, int] = {}
    names: list[str] = []
    groups = {}
    for one in primitives:
        key = _index(one.material) if by_material else one.mesh
        if key not in numbers:
            numbers[key] = len(names)
            names.append("" if key is None else names_of.get(key, f"{word} {key}"))
        groups[one.trimesh_name] = numbers[key]
    return groups, names


def _index(value: Any) -> int | None:
    """Whatever is no number stands for no material."""
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _names(header: dict[str, Any], kind: str) -> dict[int, str]:
    """Return the names of those that have one."""
    items = header.get(kind)
    return {
        index: item["name"]
        for index, item in enumerate(items if isinstance(items, list) else [])
        if isinstance(item, dict) and isinstance(item.get("name"), str) and item["name"]
    }


def _node_names(header: dict[str, Any]) -> dict[int, str]:
    """Return for each mesh the name of the first node that has it and a name."""
    found: dict[int, str] = {}
    for node, name in _names(header, "nodes").items():
        mesh = _index(header["nodes"][node].get("mesh"))
        if mesh is not None:
            found.setdefault(mesh, name)
    return found
