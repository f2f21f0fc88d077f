"""Write a compressed asset."""

from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import Asset, Part, check_asset
from prtbake_storage.decode.quantise import (
    Scales,
    asset_scales,
    bits_of,
    pack_tangents,
    pack_units,
    quantise_asset,
    round_part,
    stored_levels,
)
from prtbake_storage.decode.superclusters import Superclusters
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.basis import put_basis
from prtbake_storage.hdf5.resources import put_directions, put_mesh
from prtbake_storage.hdf5.tables import put_surface

F32 = NDArray[np.float32]
I16 = NDArray[np.int16]

AXES = {
    "light_bases": "clusters coeffs light",
    "dual_bases": "clusters vert channel*view*light",
    "means": "clusters channel*coeff",
    "components": "clusters pcs channel*coeff",
    "view_texture": "height width view channels",
    "weights": "verts ranks",
}


def write_asset(
    path: Path,
    asset: Asset,
    *,
    bits: int | Sequence[Scales] = 16,
    errors: Sequence[float] | None = None,
) -> Asset:
    """Write an asset and return it as every reader will see it.

    Parameters
    ----------
    path
        Final name; the file appears there complete or not at all.
    asset
        Float32 factors; give the exact ones, not ones that were quantised before.
    bits
        16 or 8 (integers with scales that use them all), the scales of each part, or 32 (float32,
        bit for bit).
    errors
        Squared-error ratio that rounding adds to each part, for the file to say.

    Returns
    -------
    Asset
        Equal, bit for bit, to ``read_asset(path)``.

    Raises
    ------
    ValueError
        Naming the array that breaks a rule of `check_asset`, or whose scale is too fine.
    """
    check_asset(asset)
    seen = quantise_asset(asset, bits, errors)
    with h5.new_file(path, "asset") as file:
        _put_asset(file, asset, seen, bits, errors)
    return seen


def asset_size(
    asset: Asset, *, bits: int | Sequence[Scales] = 16, errors: Sequence[float] | None = None
) -> int:
    """Return the bytes of the file that `write_asset` writes, without a file."""
    with h5.file_in_memory("asset") as file:
        _put_asset(file, asset, quantise_asset(asset, bits, errors), bits, errors)
        file.flush()
        return len(file.id.get_file_image())


def _put_asset(
    file: h5py.File,
    asset: Asset,
    seen: Asset,
    bits: int | Sequence[Scales],
    errors: Sequence[float] | None,
) -> None:
    """Write an asset, of which readers see ``seen``."""
    exact = isinstance(bits, int) and bits == 32
    scales = [None] * len(asset.parts) if exact else asset_scales(asset, bits)
    h5.set_attribute(file, "bits", 32 if exact else _most_bits(seen))
    normals = asset.normals if exact else pack_units(asset.normals)
    put_mesh(file, asset.positions, asset.faces, normals, asset.uv)
    put_basis(file, asset.basis)
    parts = h5.group(file, "parts")
    for index, part in enumerate(asset.parts):
        group = h5.group(parts, str(index))
        if errors is not None and not exact:
            h5.set_attribute(group, "quantisation_error", float(errors[index]))
        part_normals = asset.normals[slice(*part.vertex_range)]
        _put_part(group, part, part_normals, scales[index])
    h5.put_json(file, "provenance", dict(asset.provenance))


def _most_bits(asset: Asset) -> int:
    """Bits of the factor that has most of them."""
    return max(max(part.precision.bits.values()) for part in asset.parts if part.precision)


def _put_part(group: h5py.Group, part: Part, normals: F32, scales: Scales | None) -> None:
    put_surface(group, part)
    h5.set_attribute(group, "method", part.method)
    h5.put(group, "view_basis", part.view_basis, "terms view")
    clusters = h5.group(group, "clusters")
    h5.put(clusters, "labels", part.labels.astype(_smallest_type(part.n_clusters)), "verts")
    h5.put(clusters, "ranks", part.ranks, "clusters view_light_vert")
    rounded = {} if scales is None else round_part(part, scales)
    for name in AXES:
        owner = group if name in ("view_texture", "weights") else clusters
        array = getattr(part, name)
        if scales is not None and name in rounded:
            _put_levels(owner, name, rounded[name], scales[name])
        elif array is not None and array.size:
            h5.put(owner, name, array, AXES[name])
    if part.superclusters is not None:
        _put_superclusters(h5.group(group, "superclusters"), part.superclusters)
    if part.frames is not None and scales is not None:
        put_directions(group, "tangents", pack_tangents(part.name, part.frames, normals))
    elif part.frames is not None:
        h5.put(group, "frames", part.frames, "verts axes xyz")


def _smallest_type(n_labels: int) -> np.dtype[np.signedinteger]:
    """Smallest signed integer type that holds 0 to ``n_labels`` - 1."""
    return np.dtype(np.min_scalar_type(-n_labels))


def _put_superclusters(group: h5py.Group, groups: Superclusters) -> None:
    h5.set_attribute(group, "registers", groups.registers)
    h5.put(group, "of_cluster", groups.of_cluster, "clusters")
    h5.put(group, "indices", groups.indices, "draws corners")
    h5.put(group, "starts", groups.starts, "superclusters+1")


def _put_levels(group: h5py.Group, name: str, levels: I16, scale: F32) -> None:
    """Write levels in the smallest type, beside their scale."""
    stored, offset = stored_levels(levels)
    written = h5.put(group, name, stored, AXES[name])
    h5.set_attribute(written, "scale", f"{name}_scale")
    h5.set_attribute(written, "offset", offset)
    h5.set_attribute(written, "bits", bits_of(levels))
    axes = "clusters ranks" if name == "weights" else AXES[name]
    h5.put(group, f"{name}_scale", scale, axes)
