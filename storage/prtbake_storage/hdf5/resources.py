"""Canonical files of parsed inputs: meshes and environments."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.quantise import INT16_MAX
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]


@dataclass(frozen=True)
class MeshFile:
    """A repaired mesh: positions (verts, 3), faces (tris, 3), unit normals, uv (verts, 2) or None.

    ``colours`` (verts, 3) are linear Rec.709 in [0, 1], or None; ``face_groups`` (tris,) indices
    of ``group_names``, None where the file tells no groups; ``report`` is what parsing found and
    mended.
    """

    positions: F64
    faces: I32
    normals: F64
    uv: F64 | None
    report: Mapping[str, Any] = field(default_factory=dict)
    colours: F32 | None = None
    face_groups: I32 | None = None
    group_names: tuple[str, ...] = ()


@dataclass(frozen=True)
class EnvironmentFile:
    """A lat-long environment in the internal convention: linear radiance (height, width, 3)."""

    radiance: F32
    report: Mapping[str, Any] = field(default_factory=dict)


def write_mesh(path: Path, mesh: MeshFile) -> None:
    """Write the canonical file of a mesh."""
    with h5.new_file(path, "mesh") as file:
        put_mesh(file, mesh.positions, mesh.faces, mesh.normals, mesh.uv)
        put_colours(h5.child(file, "mesh"), "colours", mesh.colours)
        if mesh.face_groups is not None:
            group = h5.child(file, "mesh")
            h5.put(group, "face_groups", mesh.face_groups.astype(np.int32), "tris")
            h5.put_json(group, "group_names", list(mesh.group_names))
        h5.put_json(file, "provenance", dict(mesh.report))


def read_mesh(path: Path) -> MeshFile:
    """Read the canonical file of a mesh.

    Raises
    ------
    CorruptArtefact
        Naming the dataset that is damaged, missing or not what the schema says.
    """
    with h5.open_file(path, "mesh") as file:
        positions, faces, normals, uv = get_mesh(file)
        colours = get_colours(h5.child(file, "mesh"), "colours", len(positions))
        report = h5.get_object(file, "provenance")
        face_groups, names = _get_groups(h5.child(file, "mesh"), len(faces))
    return MeshFile(positions, faces, normals, uv, report, colours, face_groups, names)


def _get_groups(group: Any, n_faces: int) -> tuple[I32 | None, tuple[str, ...]]:
    if not h5.has(group, "face_groups"):
        return None, ()
    face_groups: I32 = h5.get_int32(group, "face_groups", (n_faces,))
    names = h5.get_json(group, "group_names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CorruptArtefact("/mesh/group_names are not a list of names")
    if len(set(names)) < len(names):
        raise CorruptArtefact("/mesh/group_names are not distinct")
    bad = np.flatnonzero((face_groups < 0) | (face_groups >= len(names)))
    if bad.size:
        raise CorruptArtefact(
            f"/mesh/face_groups: triangle {bad[0]} names a group outside [0, {len(names)})"
        )
    return face_groups, tuple(names)


def write_environment(path: Path, environment: EnvironmentFile) -> None:
    """Write the canonical file of an environment."""
    with h5.new_file(path, "environment") as file:
        group = h5.group(file, "environment")
        h5.put(group, "radiance", environment.radiance, "height width channels", unit="radiance")
        h5.put_json(file, "provenance", dict(environment.report))


def read_environment(path: Path) -> EnvironmentFile:
    """Read the canonical file of an environment; raises CorruptArtefact."""
    with h5.open_file(path, "environment") as file:
        group = h5.child(file, "environment")
        radiance = h5.get(group, "radiance", "f", (None, None, 3)).astype(np.float32)
        if (radiance < 0).any():
            raise CorruptArtefact("/environment/radiance is negative somewhere")
        return EnvironmentFile(radiance, h5.get_object(file, "provenance"))


def put_mesh(
    file: Any, positions: NDArray[Any], faces: I32, normals: NDArray[Any], uv: NDArray[Any] | None
) -> None:
    """Write the group ``mesh``."""
    group = h5.group(file, "mesh")
    h5.put(group, "positions", positions, "verts xyz", unit="scene")
    h5.put(group, "faces", faces, "tris corners")
    put_directions(group, "normals", normals)
    if uv is not None:
        h5.put(group, "uv", uv, "verts uv")


def put_directions(group: Any, name: str, directions: NDArray[Any]) -> None:
    """Write unit vectors (verts, 3); those in int16 carry their scale."""
    written = h5.put(group, name, directions, "verts xyz")
    if directions.dtype == np.int16:
        h5.set_attribute(written, "scale", 1.0 / INT16_MAX)


def put_colours(group: Any, name: str, colours: F32 | None) -> None:
    """Write linear vertex colours (verts, 3) in 32 bits; nothing for None."""
    if colours is not None:
        h5.put(group, name, colours.astype(np.float32), "verts channels")


def get_colours(group: Any, name: str, n_vertices: int) -> F32 | None:
    """Read vertex colours; None where the file has none."""
    if not h5.has(group, name):
        return None
    colours: F32 = h5.get(group, name, "f", (n_vertices, 3)).astype(np.float32)
    outside = np.flatnonzero(((colours < 0.0) | (colours > 1.0)).any(axis=1))
    if outside.size:
        raise CorruptArtefact(f"{group.name}/{name}: vertex {outside[0]} leaves [0, 1]")
    return colours


def get_mesh(file: Any) -> tuple[F64, I32, F64, F64 | None]:
    """Read the group ``mesh`` with float normals, as float64."""
    group = h5.child(file, "mesh")
    positions = h5.get(group, "positions", "f", (None, 3)).astype(np.float64)
    normals = h5.get(group, "normals", "f", (len(positions), 3)).astype(np.float64)
    faces = get_faces(group, len(positions))
    uv = None
    if h5.has(group, "uv"):
        uv = h5.get(group, "uv", "f", (len(positions), 2)).astype(np.float64)
    check_unit("/mesh/normals", normals)
    return positions, faces, normals, uv


def get_faces(group: Any, n_vertices: int) -> I32:
    """Read ``faces`` and hold every index against the number of vertices."""
    faces: I32 = h5.get_int32(group, "faces", (None, 3))
    bad = np.flatnonzero(((faces < 0) | (faces >= n_vertices)).any(axis=1))
    if bad.size:
        raise CorruptArtefact(
            f"/mesh/faces: triangle {bad[0]} names a vertex outside [0, {n_vertices})"
        )
    return faces


def check_unit(name: str, vectors: NDArray[Any], tolerance: float = 1e-3) -> None:
    """Refuse vectors that are not of unit length."""
    off = np.abs(np.linalg.norm(vectors, axis=-1) - 1.0)
    if off.size and off.max() > tolerance:
        raise CorruptArtefact(f"{name}: row {int(off.argmax())} is not of unit length")
