"""Read a compressed asset from a file that nobody vouches for."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import FACTORS, Asset, Part, Precision, check_asset
from prtbake_storage.decode.quantise import (
    SHARED_AXES,
    bits_of,
    dequantised,
    unpack_frames,
    unpack_units,
)
from prtbake_storage.decode.superclusters import Superclusters
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.basis import get_basis
from prtbake_storage.hdf5.resources import check_unit, get_faces
from prtbake_storage.hdf5.tables import child_parts, get_surface

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]


def read_asset(path: Path) -> Asset:
    """Read an asset, whatever number of bits it holds, as float32.

    Raises
    ------
    CorruptArtefact
        Naming the dataset that is damaged, missing, not finite or not what the schema says.
    """
    with h5.open_file(path, "asset") as file:
        mesh = h5.child(file, "mesh")
        positions: F32 = h5.get(mesh, "positions", "f", (None, 3)).astype(np.float32)
        normals = _normals(mesh, len(positions))
        uv = None
        if h5.has(mesh, "uv"):
            uv = h5.get(mesh, "uv", "f", (len(positions), 2)).astype(np.float32)
        basis = get_basis(file)
        parts = tuple(_part(group, normals) for group in child_parts(file))
        asset = Asset(
            positions=positions,
            faces=get_faces(mesh, len(positions)),
            normals=normals,
            uv=uv,
            parts=parts,
            basis=basis,
            provenance=h5.get_object(file, "provenance"),
        )
    try:
        check_asset(asset)
    except ValueError as error:
        raise CorruptArtefact(str(error)) from error
    return asset


def _normals(mesh: h5py.Group, n_vertices: int) -> F32:
    stored = h5.get(mesh, "normals", "fi", (n_vertices, 3))
    normals = unpack_units(stored) if stored.dtype == np.int16 else stored.astype(np.float32)
    check_unit("/mesh/normals", normals)
    return normals


def _part(group: h5py.Group, normals: F32) -> Part:
    surface = get_surface(group)
    method = h5.attribute(group, "method")
    if method not in FACTORS:
        raise CorruptArtefact(f"{group.name}: method is {method!r}")
    start, stop = surface["vertex_range"]
    verts = stop - start
    if stop > len(normals):
        raise CorruptArtefact(f"{group.name}: vertices {start}..{stop} of {len(normals)}")
    clusters = h5.child(group, "clusters")
    ranks = h5.get_int32(clusters, "ranks", (None, 3))
    labels = h5.get_int32(clusters, "labels", (verts,))
    if labels.min() < 0 or labels.max() >= len(ranks):
        raise CorruptArtefact(f"{clusters.name}/labels leave [0, {len(ranks)})")
    bits: dict[str, int] = {}
    factors: dict[str, Any] = {
        name: _factor(clusters, name, 2 if name == "means" else 3, labels, bits)
        for name in FACTORS[method]
        if name != "weights"
    }
    if h5.has(group, "view_texture"):
        factors["view_texture"] = _factor(group, "view_texture", 4, labels, bits)
    if "weights" in FACTORS[method]:
        weights = _factor(group, "weights", 2, labels, bits, len(ranks))
    else:
        weights = np.zeros((verts, 0), np.float32)
        factors["components"] = np.zeros((len(ranks), 0, factors["means"].shape[1]), np.float32)
    return Part(
        **surface,
        method=method,
        labels=labels,
        weights=weights,
        ranks=ranks,
        view_basis=h5.get(group, "view_basis", "f", (None, None)).astype(np.float32),
        frames=_frames(group, normals[start:stop]),
        precision=_precision(group, bits),
        superclusters=_superclusters(group, len(ranks)),
        **factors,
    )


def _superclusters(group: h5py.Group, n_clusters: int) -> Superclusters | None:
    if not h5.has(group, "superclusters"):
        return None
    own = h5.child(group, "superclusters")
    registers = h5.attribute(own, "registers")
    if not isinstance(registers, int):
        raise CorruptArtefact(f"{own.name}: registers is {registers!r}, not a whole number")
    return Superclusters(
        registers=registers,
        of_cluster=h5.get_int32(own, "of_cluster", (n_clusters,)),
        indices=h5.get_int32(own, "indices", (None, 3)),
        starts=h5.get_int32(own, "starts", (None,)),
    )


def _factor(
    group: h5py.Group,
    name: str,
    axes: int,
    labels: I32,
    bits: dict[str, int],
    n_clusters: int = 0,
) -> F32:
    """Read a factor of the given number of axes, and enter in ``bits`` how it was rounded."""
    shape = (len(labels), None) if name == "weights" else (None,) * axes
    array = h5.get(group, name, "fi", shape)
    if array.dtype.kind == "f":
        return array.astype(np.float32)
    shared = SHARED_AXES.get(name, ())
    scale_shape = tuple(1 if axis in shared else size for axis, size in enumerate(array.shape))
    if name == "weights":
        scale_shape = (n_clusters, array.shape[1])
    scale: F32 = h5.get(group, f"{name}_scale", "f", scale_shape).astype(np.float32)
    offset, bits[name] = _precision_of(h5.dataset(group, name, "i", axes), array)
    return dequantised(name, array, scale, labels, offset=offset)


def _precision_of(source: h5py.Dataset, stored: NDArray[Any]) -> tuple[int, int]:
    """Return what levels are stored above, and their bits.

    Files from before these were chosen have neither attribute.
    """
    offset = h5.attribute(source, "offset") if h5.has_attribute(source, "offset") else 0
    if not isinstance(offset, int) or not 0 <= offset < 1 << 15:
        raise CorruptArtefact(f"{source.name}: offset is {offset!r}")
    if stored.dtype.itemsize > 2:
        raise CorruptArtefact(f"{source.name} is {stored.dtype}, of more than 16 bits")
    found = bits_of(stored, offset=offset)
    if not h5.has_attribute(source, "bits"):
        return offset, found
    stated = h5.attribute(source, "bits")
    if stated != found:
        raise CorruptArtefact(f"{source.name}: bits is {stated!r}, its levels take {found}")
    return offset, found


def _precision(group: h5py.Group, bits: dict[str, int]) -> Precision | None:
    """Return how a part was rounded; None where its factors are float32."""
    if not bits:
        return None
    error = None
    if h5.has_attribute(group, "quantisation_error"):
        error = h5.attribute(group, "quantisation_error")
        if not isinstance(error, int | float) or not 0.0 <= error < np.inf:
            raise CorruptArtefact(f"{group.name}: quantisation_error is {error!r}")
    return Precision(bits=bits, error=error)


def _frames(group: h5py.Group, normals: F32) -> F32 | None:
    if h5.has(group, "tangents"):
        return unpack_frames(h5.get(group, "tangents", "i", (len(normals), 3)), normals)
    if h5.has(group, "frames"):
        frames: F32 = h5.get(group, "frames", "f", (len(normals), 3, 3)).astype(np.float32)
        check_unit(f"{group.name}/frames", frames)
        return frames
    return None
