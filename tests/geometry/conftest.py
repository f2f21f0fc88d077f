"""Shapes and files that the geometry tests share."""

import json
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

CUBE_OBJ = """\
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
f 4 3 2 1
f 5 6 7 8
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""


@pytest.fixture
def cube_obj() -> bytes:
    """A unit cube of six quads, wound outwards."""
    return CUBE_OBJ.encode()


@pytest.fixture
def pack_glb() -> Callable[..., bytes]:
    """Pack a glTF header and binary data into GLB."""

    def pack(header: dict[str, Any], binary: bytes = b"") -> bytes:
        text = json.dumps(header).encode()
        text += b" " * (-len(text) % 4)
        binary += b"\0" * (-len(binary) % 4)
        total = 12 + 8 + len(text) + 8 + len(binary)
        return (
            struct.pack("<5I", 0x46546C67, 2, total, len(text), 0x4E4F534A)
            + text
            + struct.pack("<2I", len(binary), 0x004E4942)
            + binary
        )

    return pack


@pytest.fixture
def triangle_gltf() -> tuple[dict[str, Any], bytes]:
    """One triangle in the plane z = 0, with indices and texture coordinates, as header and data."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32).tobytes()
    uv = np.array([[0, 0], [1, 0], [0, 0.25]], np.float32).tobytes()
    indices = np.array([0, 1, 2], np.uint16).tobytes()
    header = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2}]}
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
            {"buffer": 0, "byteOffset": 60, "byteLength": 6},
        ],
        "buffers": [{"byteLength": 66}],
    }
    return header, positions + uv + indices
