"""Binary glTF: check the header, and keep only the geometry, before trimesh sees the file.

A hostile file may name other files, hold a picture that unpacks to gigabytes, declare accessors
far larger than the file, or share nodes so that the scene unfolds exponentially.  Also, trimesh
reads some legal content wrongly without a word: it ignores sparse accessors, leaves normalised
integers as they are, and drops a node that carries a camera.  Such content is refused here or
rewritten so that it is read right.
"""

import json
import struct
from typing import Any, NamedTuple

from prtbake_storage.errors import MeshError, TooLarge
from prtbake_workers.geometry.glb_groups import Primitive, group_primitives
from prtbake_workers.geometry.raw_mesh import MeshLimits

UV_ATTRIBUTE = "_PRTBAKE_UV"
"""TEXCOORD_0 goes through trimesh as a custom attribute: it reads texture coordinates only
together with a material, and materials bring pictures."""

NORMAL_ATTRIBUTE = "_PRTBAKE_NORMAL"
"""NORMAL goes the same way: trimesh would compute normals where a part has none."""

COLOUR_ATTRIBUTE = "_PRTBAKE_COLOUR"
"""COLOR_0 goes the same way: trimesh would round it to bytes."""

MAX_OVERLAP = 16
"""Views of one file share its bytes at most this many times; well-made files do not share them."""

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_TRIANGLES, _STRIP = 4, 5
_COMPONENT_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_TYPE_COMPONENTS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_FLOAT = 5126
_NORMAL_COMPONENTS = (5120, 5122, 5126)
"""Signed bytes and shorts are normals times 127 and 32767: their direction is right as it is."""

_COLOUR_COMPONENTS = (5121, 5123, 5126)
"""Bytes, shorts and floats; whole numbers are normalised whether the file says so or not, as the
format demands it [Khronos2021]_ 3.7.2.1."""


class GuardedGlb(NamedTuple):
    """What `guard_glb` leaves of a file.

    ``data`` is a GLB file with the same geometry and nothing else, ``warnings`` what was left out.
    ``groups`` gives the group of the primitives by the names that trimesh calls them by, an index
    of ``group_names``.
    """

    data: bytes
    warnings: list[str]
    groups: dict[str, int]
    group_names: list[str]


def guard_glb(data: bytes, limits: MeshLimits) -> GuardedGlb:
    """Rewrite a GLB file down to nodes, triangles and the buffers they use.

    Raises
    ------
    MeshError
        The file is not a GLB, refers to another file, is packed in a way that is not read, or
        declares more than it holds; the message names the element.
    TooLarge
        The unfolded scene exceeds the limits.
    """
    header, binary = _split_chunks(data)
    for index, buffer in enumerate(_list(header, "buffers")):
        if "uri" in buffer:
            raise MeshError(
                f"glTF buffers[{index}] refers to '{str(buffer['uri'])[:40]}': only a GLB that "
                "holds its own data is read"
            )
    warnings: list[str] = []
    accessors = _list(header, "accessors")
    meshes = []
    sources: list[Primitive] = []
    for index, mesh in enumerate(_list(header, "meshes")):
        primitives: list[dict[str, Any]] = []
        for place, primitive in enumerate(_list(mesh, "primitives")):
            where = f"meshes[{index}].primitives[{place}]"
            kept = _keep_primitive(primitive, where, header, len(binary), warnings)
            if kept is not None:
                sources.append(Primitive(index, len(primitives), primitive.get("material")))
                primitives.append(kept)
        meshes.append({"name": f"mesh{index}", "primitives": primitives})
    nodes = _keep_nodes(header, meshes, accessors, limits)
    accessors, views = _keep_used(header, meshes, len(binary), limits)
    scene = _root_nodes(header)
    out = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": scene}],
        "nodes": nodes,
        "meshes": meshes,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(out).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    rewritten = (
        struct.pack("<5I", _MAGIC, 2, total, len(text), _JSON)
        + text
        + struct.pack("<2I", len(binary), _BIN)
        + binary
    )
    return GuardedGlb(rewritten, warnings, *group_primitives(header, sources))


def _split_chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    if len(data) < 20:
        raise MeshError("GLB: the file is shorter than its header")
    magic, version, _, length, kind = struct.unpack_from("<5I", data)
    if magic != _MAGIC or kind != _JSON:
        raise MeshError("GLB: the file does not begin with a glTF header and a JSON chunk")
    if version != 2:
        raise MeshError(f"GLB: glTF version {version}; only 2 is read")
    try:
        header = json.loads(data[20 : 20 + length])
    except (ValueError, RecursionError) as error:
        raise MeshError(f"GLB: the JSON chunk cannot be read: {error}") from None
    if not isinstance(header, dict):
        raise MeshError("GLB: the JSON chunk is not an object")
    start = 20 + length
    binary = b""
    if len(data) >= start + 8:
        length, kind = struct.unpack_from("<2I", data, start)
        binary = data[start + 8 : start + 8 + length]
        if kind != _BIN or len(binary) != length:
            raise MeshError("GLB: the binary chunk is cut off or of another kind")
    return header, binary


def _list(parent: dict[str, Any], key: str) -> list[dict[str, Any]]:
    value = parent.get(key, [])
    if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
        raise MeshError(f"glTF {key}: not a list of objects")
    return value


def _item(items: list[dict[str, Any]], index: Any, where: str) -> dict[str, Any]:
    if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(items):
        raise MeshError(f"glTF {where}: index {index!r} points nowhere")
    return items[index]


def _count(parent: dict[str, Any], key: str, where: str, default: int | None = None) -> int:
    value = parent.get(key, default)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**40:
        raise MeshError(f"glTF {where}.{key}: {value!r} is not a count")
    return value


def _keep_primitive(
    primitive: dict[str, Any],
    where: str,
    header: dict[str, Any],
    n_bytes: int,
    warnings: list[str],
) -> dict[str, Any] | None:
    """Return the primitive's geometry, checked; None (and a warning) if it has no triangles."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP):
        warnings.append(
            f"{where}: drawing mode {mode} left out; only triangles and strips are read"
        )
        return None
    for name in primitive.get("extensions", {}):
        if "compression" in str(name):
            raise MeshError(f"glTF {where}: packed with {name}, which is not read")
    attributes = primitive.get("attributes", {})
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        raise MeshError(f"glTF {where}: no POSITION")
    kept: dict[str, Any] = {"mode": mode, "attributes": {"POSITION": attributes["POSITION"]}}
    _check_accessor(header, attributes["POSITION"], f"{where}.POSITION", n_bytes, "VEC3")
    if "TEXCOORD_0" in attributes:
        _check_accessor(header, attributes["TEXCOORD_0"], f"{where}.TEXCOORD_0", n_bytes, "VEC2")
        kept["attributes"][UV_ATTRIBUTE] = attributes["TEXCOORD_0"]
    if "NORMAL" in attributes:
        index, place = attributes["NORMAL"], f"{where}.NORMAL"
        if _is_plain(header, index, place, "VEC3", _NORMAL_COMPONENTS):
            _check_accessor(header, index, place, n_bytes, "VEC3", _NORMAL_COMPONENTS)
            kept["attributes"][NORMAL_ATTRIBUTE] = index
        else:
            warnings.append(f"{where}: NORMAL is packed in a way that is not read: computed")
    if "COLOR_0" in attributes:
        index, place = attributes["COLOR_0"], f"{where}.COLOR_0"
        kind = _item(_list(header, "accessors"), index, place).get("type")
        if kind in ("VEC3", "VEC4") and _is_plain(header, index, place, kind, _COLOUR_COMPONENTS):
            _check_accessor(header, index, place, n_bytes, kind, _COLOUR_COMPONENTS)
            kept["attributes"][COLOUR_ATTRIBUTE] = index
        else:
            warnings.append(f"{where}: COLOR_0 is packed in a way that is not read: left out")
    if "indices" in primitive:
        _check_accessor(header, primitive["indices"], f"{where}.indices", n_bytes, "SCALAR")
        kept["indices"] = primitive["indices"]
    accessors = _list(header, "accessors")
    used = [primitive["indices"]] if "indices" in kept else []
    if not all(accessors[index]["count"] for index in [*used, attributes["POSITION"]]):
        warnings.append(f"{where}: empty, left out")
        return None
    return kept


def _keep_used(
    header: dict[str, Any], meshes: list[dict[str, Any]], n_bytes: int, limits: MeshLimits
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Blank the accessors and views that no triangle uses, keeping the numbering of the rest."""
    used: set[int] = set()
    for mesh in meshes:
        for primitive in mesh["primitives"]:
            used |= {primitive["indices"]} if "indices" in primitive else set()
            used |= set(primitive["attributes"].values())
    accessors = _list(header, "accessors")
    views = _list(header, "bufferViews")
    used_views = {accessors[index]["bufferView"] for index in used}
    # each view is copied once and each accessor twice: overlapping ones multiply the file
    n_elements = sum(accessors[index]["count"] for index in used)
    n_view_bytes = sum(views[index]["byteLength"] for index in used_views)
    # three indices a triangle, four attributes a vertex
    if (
        n_elements > 3 * limits.triangles + 4 * limits.vertices
        or n_view_bytes > MAX_OVERLAP * n_bytes
    ):
        raise TooLarge(
            f"glTF accessors hold {n_elements} elements and views {n_view_bytes} bytes in all, "
            f"of a file with {n_bytes} bytes of data"
        )
    blank = {"componentType": 5121, "count": 0, "type": "SCALAR"}
    return (
        [item if index in used else blank for index, item in enumerate(accessors)],
        [
            item if index in used_views else {"buffer": 0, "byteLength": 0}
            for index, item in enumerate(views)
        ],
    )


def _is_plain(
    header: dict[str, Any], index: Any, where: str, kind: str, components: tuple[int, ...]
) -> bool:
    """Whether an attribute can be read that the mesh can do without, so that none is refused."""
    accessor = _item(_list(header, "accessors"), index, where)
    return (
        accessor.get("type") == kind
        and accessor.get("componentType") in components
        and "sparse" not in accessor
        and "bufferView" in accessor
    )


def _check_accessor(
    header: dict[str, Any],
    index: Any,
    where: str,
    n_bytes: int,
    kind: str,
    components: tuple[int, ...] = (_FLOAT,),
) -> None:
    """Refuse an accessor that reaches beyond the file or that would be read wrongly."""
    accessor = _item(_list(header, "accessors"), index, where)
    where = f"accessors[{index}] ({where})"
    component = accessor.get("componentType")
    if accessor.get("type") != kind or component not in _COMPONENT_BYTES:
        raise MeshError(f"glTF {where}: a {accessor.get('type')} of {component}, not a {kind}")
    if component == _FLOAT if kind == "SCALAR" else component not in components:
        raise MeshError(f"glTF {where}: component type {component} is not read here")
    if "sparse" in accessor or "bufferView" not in accessor:
        raise MeshError(f"glTF {where}: sparse or without data, which is not read")
    view_index = accessor["bufferView"]
    view = _item(_list(header, "bufferViews"), view_index, where)
    count = _count(accessor, "count", where)
    size = _COMPONENT_BYTES[component] * _TYPE_COMPONENTS[kind]
    stride = _count(view, "byteStride", f"bufferViews[{view_index}]", default=size) or size
    start = _count(view, "byteOffset", f"bufferViews[{view_index}]", default=0)
    length = _count(view, "byteLength", f"bufferViews[{view_index}]")
    offset = _count(accessor, "byteOffset", where, default=0)
    needed = offset + max(count - 1, 0) * stride + (size if count else 0)
    if view.get("buffer") != 0 or needed > length or start + length > n_bytes:
        raise MeshError(f"glTF {where}: {count} elements reach beyond the data of the file")


def _root_nodes(header: dict[str, Any]) -> list[int]:
    scenes = _list(header, "scenes")
    if not scenes:
        return []
    roots = _item(scenes, header.get("scene", 0), "scene").get("nodes", [])
    if not isinstance(roots, list):
        raise MeshError("glTF scene.nodes: not a list")
    return roots


def _keep_nodes(
    header: dict[str, Any],
    meshes: list[dict[str, Any]],
    accessors: list[dict[str, Any]],
    limits: MeshLimits,
) -> list[dict[str, Any]]:
    """Return the nodes' transforms and meshes; refuse what is no tree, and what grows too large."""
    nodes = _list(header, "nodes")
    kept: list[dict[str, Any]] = [{} for _ in nodes]
    parent_of: dict[int, str] = {}
    n_vertices = n_triangles = 0
    stack = [(index, "scene") for index in _root_nodes(header)]
    while stack:
        index, parent = stack.pop()
        node = _item(nodes, index, f"{parent}.children")
        if index in parent_of or len(parent_of) >= limits.nodes:
            raise MeshError(
                f"glTF nodes[{index}]: reached twice ({parent_of.get(index)} and {parent}) or one "
                f"of more than {limits.nodes} nodes; the nodes must form trees"
            )
        parent_of[index] = parent
        keep: dict[str, Any] = {
            key: node[key]
            for key in ("matrix", "translation", "rotation", "scale", "children")
            if key in node
        }
        if "mesh" in node:
            mesh = _item(meshes, node["mesh"], f"nodes[{index}].mesh")
            if mesh["primitives"]:
                keep["mesh"] = node["mesh"]
            for primitive in mesh["primitives"]:
                count = accessors[primitive["attributes"]["POSITION"]]["count"]
                n_vertices += count
                n_triangles += (
                    accessors[primitive["indices"]]["count"] if "indices" in primitive else count
                ) // (3 if primitive["mode"] == _TRIANGLES else 1)
            limits.check(vertices=n_vertices, triangles=n_triangles)
        kept[index] = {**keep, "name": f"node{index}"}
        children = node.get("children", [])
        if not isinstance(children, list):
            raise MeshError(f"glTF nodes[{index}].children: not a list")
        stack += [(child, f"nodes[{index}]") for child in children]
    return kept
