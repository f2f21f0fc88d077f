"""Write a compressed asset."""

from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import Asset, Part, check_asset
from prtbake_storage.decode.quantise import (
    SHARED_AXES,
    pack_tangents,
    pack_units,
    quantise,
    quantise_asset,
    quantise_weights,
)
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.basis import put_basis
from prtbake_storage.hdf5.resources import put_directions, put_mesh
from prtbake_storage.hdf5.tables import put_surface

F32 = NDArray[np.float32]

AXES = {
    "light_bases": "clusters coeffs light",
    "dual_bases": "clusters vert channel*view*light",
    "means": "clusters channel*coeff",
    "components": "clusters pcs channel*coeff",
    "view_texture": "height width view channels",
}


def write_asset(path: Path, asset: Asset, *, bits: int = 16) -> Asset:
    """Write an asset and return it as every reader will see it.

    Parameters
    ----------
    path
        Final name; the file appears there complete or not at all.
    asset
        Float32 factors; give the exact ones, not ones that were quantised before.
    bits
        16 (int16 with scales) or 32 (float32, bit for bit).

    Returns
    -------
    Asset
        Equal, bit for bit, to ``read_asset(path)``.

    Raises
    ------
    ValueError
        Naming the array that breaks a rule of `check_asset`.
    """
    check_asset(asset)
    seen = quantise_asset(asset, bits)
    with h5.new_file(path, "asset") as file:
        h5.set_attribute(file, "bits", bits)
        normals = pack_units(asset.normals) if bits == 16 else asset.normals
        put_mesh(file, asset.positions, asset.faces, normals, asset.uv)
        put_basis(file, asset.basis)
        parts = h5.group(file, "parts")
        for index, part in enumerate(asset.parts):
            part_normals = asset.normals[slice(*part.vertex_range)]
            _put_part(h5.group(parts, str(index)), part, part_normals, bits)
        h5.put_json(file, "provenance", dict(asset.provenance))
    return seen


def _put_part(group: h5py.Group, part: Part, normals: F32, bits: int) -> None:
    put_surface(group, part)
    h5.set_attribute(group, "method", part.method)
    h5.put(group, "view_basis", part.view_basis, "terms view")
    clusters = h5.group(group, "clusters")
    h5.put(clusters, "labels", part.labels, "verts")
    h5.put(clusters, "ranks", part.ranks, "clusters view_light_vert")
    for name in ("light_bases", "dual_bases", "means", "components"):
        _put_factor(clusters, name, getattr(part, name), bits)
    _put_factor(group, "view_texture", part.view_texture, bits)
    if bits == 16:
        values, scale = quantise_weights(part.weights, part.labels, part.n_clusters)
        _put_scaled(group, "weights", values, scale, "verts ranks", "clusters ranks")
    else:
        h5.put(group, "weights", part.weights, "verts ranks")
    if part.frames is not None and bits == 16:
        put_directions(group, "tangents", pack_tangents(part.name, part.frames, normals))
    elif part.frames is not None:
        h5.put(group, "frames", part.frames, "verts axes xyz")


def _put_factor(group: h5py.Group, name: str, array: F32 | None, bits: int) -> None:
    if array is None:
        return
    if bits == 16:
        packed = quantise(array, SHARED_AXES[name])
        _put_scaled(group, name, packed.values, packed.scale, AXES[name], AXES[name])
    else:
        h5.put(group, name, array, AXES[name])


def _put_scaled(
    group: h5py.Group, name: str, values: NDArray[np.int16], scale: F32, axes: str, scale_axes: str
) -> None:
    written = h5.put(group, name, values, axes)
    h5.set_attribute(written, "scale", f"{name}_scale")
    h5.put(group, f"{name}_scale", scale, scale_axes)
