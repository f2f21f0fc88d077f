"""The GLB guard: hostile headers are refused, sound ones keep their geometry and nothing else."""

import copy
import json
import struct

import numpy as np
import pytest

from prtbake_storage.errors import MeshError, TooLarge
from prtbake_workers.geometry.glb_guard import NORMAL_ATTRIBUTE, UV_ATTRIBUTE, guard_glb
from prtbake_workers.geometry.raw_mesh import MeshLimits

LIMITS = MeshLimits()


def header_of(data):
    (length,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + length])


def test_only_geometry_is_kept(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header |= {
        "images": [{"bufferView": 0, "mimeType": "image/png"}],
        "textures": [{"source": 0}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "cameras": [{"type": "perspective"}],
        "animations": [{}],
        "extras": {"x": "y"},
    }
    header["nodes"][0] |= {"camera": 0, "name": "../../x", "translation": [1, 2, 3]}
    header["meshes"][0]["primitives"][0]["material"] = 0
    kept, warnings, *_ = guard_glb(pack_glb(header, binary), LIMITS)
    assert warnings == []
    out = header_of(kept)
    assert set(out) == {
        "asset", "scene", "scenes", "nodes", "meshes", "accessors", "bufferViews", "buffers"
    }  # fmt: skip
    assert out["nodes"] == [{"mesh": 0, "translation": [1, 2, 3], "name": "node0"}]
    primitive = out["meshes"][0]["primitives"][0]
    assert primitive["attributes"] == {"POSITION": 0, UV_ATTRIBUTE: 1}


def with_normals(triangle_gltf, **accessor):
    """Positions again serve as normals."""
    header, binary = copy.deepcopy(triangle_gltf)
    header["accessors"].append(
        {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", **accessor}
    )
    header["meshes"][0]["primitives"][0]["attributes"]["NORMAL"] = 3
    return header, binary


def test_normals_pass_as_an_attribute_of_our_own(pack_glb, triangle_gltf):
    kept, warnings, *_ = guard_glb(pack_glb(*with_normals(triangle_gltf)), LIMITS)
    attributes = header_of(kept)["meshes"][0]["primitives"][0]["attributes"]
    assert attributes == {"POSITION": 0, UV_ATTRIBUTE: 1, NORMAL_ATTRIBUTE: 3}
    assert warnings == []


@pytest.mark.parametrize(
    "accessor", [{"componentType": 5121}, {"type": "VEC4"}, {"sparse": {"count": 1}}]
)
def test_normals_that_are_not_read_are_left_out_and_said(pack_glb, triangle_gltf, accessor):
    kept, warnings, *_ = guard_glb(pack_glb(*with_normals(triangle_gltf, **accessor)), LIMITS)
    attributes = header_of(kept)["meshes"][0]["primitives"][0]["attributes"]
    assert NORMAL_ATTRIBUTE not in attributes
    assert warnings == [
        "meshes[0].primitives[0]: NORMAL is packed in a way that is not read: computed"
    ]


@pytest.mark.parametrize(
    ("accessor", "message"),
    [({"count": 4}, "beyond the data"), ({"bufferView": 9}, "points nowhere")],
)
def test_normals_beyond_the_data_are_refused(pack_glb, triangle_gltf, accessor, message):
    with pytest.raises(MeshError, match=message):
        guard_glb(pack_glb(*with_normals(triangle_gltf, **accessor)), LIMITS)


def test_unused_accessors_are_blanked(pack_glb, triangle_gltf):
    """trimesh would allocate every accessor, used or not."""
    header, binary = triangle_gltf
    header["accessors"].append({"componentType": 5126, "count": 2**39, "type": "MAT4"})
    header["bufferViews"].append({"buffer": 7, "byteLength": 2**39})
    out = header_of(guard_glb(pack_glb(header, binary), LIMITS)[0])
    assert out["accessors"][3]["count"] == 0
    assert out["bufferViews"][3]["byteLength"] == 0


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (["buffers", 0, "uri"], "../secret.bin", "refers to '../secret.bin'"),
        (["buffers", 0, "uri"], "http://x/y", "only a GLB that holds its own data"),
        (["accessors", 0, "count"], 4, r"accessors\[0\].*beyond the data"),
        (["accessors", 0, "count"], 2**60, "not a count"),
        (["accessors", 0, "count"], -1, "not a count"),
        (["accessors", 0, "count"], True, "not a count"),
        (["accessors", 2, "byteOffset"], 2, r"accessors\[2\].*beyond the data"),
        (["accessors", 0, "sparse"], {"count": 1}, "sparse"),
        (["accessors", 0, "componentType"], 5122, "component type 5122"),
        (["accessors", 2, "componentType"], 5126, "component type 5126"),
        (["accessors", 0, "type"], "VEC2", "not a VEC3"),
        (["accessors", 0, "bufferView"], 9, "points nowhere"),
        (["bufferViews", 0, "byteLength"], 10**6, "beyond the data"),
        (["bufferViews", 0, "buffer"], 1, "beyond the data"),
        (["bufferViews", 0, "byteStride"], 24, "beyond the data"),
        (["meshes", 0, "primitives", 0, "attributes"], {}, "no POSITION"),
        (["meshes", 0, "primitives", 0, "indices"], 8, "points nowhere"),
        (
            ["meshes", 0, "primitives", 0, "extensions"],
            {"KHR_draco_mesh_compression": {}},
            "packed with KHR_draco",
        ),
        (["nodes", 0, "mesh"], 3, "points nowhere"),
        (["nodes", 0, "children"], [0], "reached twice"),
        (["nodes", 0, "children"], [5], "points nowhere"),
        (["nodes", 0, "children"], 5, "not a list"),
        (["nodes"], {"a": 1}, "not a list of objects"),
        (["scenes", 0, "nodes"], [0, 0], "reached twice"),
        (["scene"], 2, "points nowhere"),
    ],
)
def test_refusals_name_the_element(pack_glb, triangle_gltf, path, value, message):
    header, binary = copy.deepcopy(triangle_gltf)
    target = header
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(MeshError, match=message):
        guard_glb(pack_glb(header, binary), LIMITS)


def test_sharing_nodes_cannot_unfold_exponentially(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header["nodes"] = [{"children": [i + 1, i + 1]} for i in range(40)] + [{"mesh": 0}]
    with pytest.raises(MeshError, match="reached twice"):
        guard_glb(pack_glb(header, binary), LIMITS)


def test_instances_count_against_the_limits(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header["nodes"] = [{"mesh": 0}] * 10
    header["scenes"][0]["nodes"] = list(range(10))
    guard_glb(pack_glb(header, binary), MeshLimits(vertices=30))
    with pytest.raises(TooLarge, match="vertices; the limit is 29"):
        guard_glb(pack_glb(header, binary), MeshLimits(vertices=29))
    with pytest.raises(TooLarge, match="triangles; the limit is 9"):
        guard_glb(pack_glb(header, binary), MeshLimits(triangles=9))


def test_overlapping_views_cannot_multiply_the_file(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header["bufferViews"] = [{"buffer": 0, "byteLength": 66}] * 40
    header["accessors"] = [
        {"bufferView": i, "componentType": 5126, "count": 3, "type": "VEC3"} for i in range(40)
    ]
    header["meshes"][0]["primitives"] = [{"attributes": {"POSITION": i}} for i in range(40)]
    with pytest.raises(TooLarge, match="views 2640 bytes"):
        guard_glb(pack_glb(header, binary), LIMITS)


def test_other_drawing_modes_are_left_out_and_said(pack_glb, triangle_gltf):
    header, binary = triangle_gltf
    header["meshes"][0]["primitives"][0]["mode"] = 1
    _, warnings, *_ = guard_glb(pack_glb(header, binary), LIMITS)
    assert warnings == [
        "meshes[0].primitives[0]: drawing mode 1 left out; only triangles and strips are read"
    ]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"glTF", "shorter than its header"),
        (b"glTF" + struct.pack("<4I", 1, 20, 0, 0x4E4F534A), "version 1"),
        (b"glTF" + struct.pack("<4I", 2, 20, 0, 0), "does not begin"),
        (b"glTF" + struct.pack("<4I", 2, 22, 2, 0x4E4F534A) + b"[]", "not an object"),
        (b"glTF" + struct.pack("<4I", 2, 22, 2, 0x4E4F534A) + b"{,", "cannot be read"),
        (
            b"glTF" + struct.pack("<4I", 2, 22, 2, 0x4E4F534A) + b"{}"
            + struct.pack("<2I", 99, 0x004E4942) + b"x",
            "cut off",
        ),
        (b"glTF" + struct.pack("<4I", 2, 9, 200_000, 0x4E4F534A) + b"[" * 200_000, "cannot be read"),
    ],
)  # fmt: skip
def test_broken_containers_are_refused(data, message):
    with pytest.raises(MeshError, match=message):
        guard_glb(data, LIMITS)


def test_strided_accessors_pass(pack_glb, triangle_gltf):
    header, _ = triangle_gltf
    interleaved = np.zeros((3, 5), np.float32)
    binary = interleaved.tobytes() + np.array([0, 1, 2], np.uint16).tobytes()
    header["bufferViews"] = [
        {"buffer": 0, "byteLength": 60, "byteStride": 20},
        {"buffer": 0, "byteLength": 60, "byteStride": 20},
        {"buffer": 0, "byteOffset": 60, "byteLength": 6},
    ]
    header["accessors"][1]["byteOffset"] = 12
    guard_glb(pack_glb(header, binary), LIMITS)
