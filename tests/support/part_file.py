"""What a part's factors take in a file that an asset was written to."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.quantise import Scales
from prtbake_storage.hdf5.writer import write_asset
from prtbake_workers.compress.bit_allocation import allocate_bits
from prtbake_workers.compress.methods import Compressed

OWNERS = {"view_texture": "parts/0", "weights": "parts/0"}
"""Where a factor lies, if not with the clusters."""


def part_of(done: Compressed, view_texture=None, n_channels: int = 1) -> Part:
    """A part of nothing but a compression's factors and its view side."""
    n_verts = len(done.factors["labels"])
    return Part(
        name="part",
        role="object",
        vertex_range=(0, n_verts),
        material={},
        method="cta" if "light_bases" in done.factors else "cpca",
        albedo=np.ones(1, np.float32),
        view_texture=view_texture,
        n_channels=n_channels,
        **done.factors,
    )


def bytes_in_file(part: Part, scales: Scales, basis, path: Path) -> dict[str, tuple[int, int]]:
    """Bytes and numbers of every rounded factor, its scales included, as the writer leaves them."""
    n_verts = part.vertex_range[1]
    written = dict(scales)
    if part.view_texture is None and part.n_view > 1:
        # a file shows its parts from somewhere; what does it is not looked at
        part = replace(part, view_texture=np.zeros((2, 2, part.n_view, 1), np.float32))
        written["view_texture"] = np.zeros((1, 1, part.n_view, 1), np.float32)
    if part.view_texture is not None:
        part = replace(part, frames=np.tile(np.eye(3, dtype=np.float32), (n_verts, 1, 1)))
    asset = Asset(
        positions=np.zeros((n_verts, 3), np.float32),
        faces=np.array([[0, 1, 2]], np.int32),
        normals=np.tile(np.array([0.0, 0.0, 1.0], np.float32), (n_verts, 1)),
        uv=None,
        parts=(part,),
        basis=basis,
    )
    write_asset(path, asset, bits=[written])
    found = {}
    with h5py.File(path) as file:
        for name in scales:
            owner = file[OWNERS.get(name, "parts/0/clusters")]
            stored, scale = owner[name].id, owner[f"{name}_scale"].id
            size = stored.get_storage_size() + scale.get_storage_size()
            found[name] = size, int(np.prod(stored.shape))
    return found


def factor_bytes_in_file(done: Compressed, areas, share: float, basis, path: Path) -> float:
    """Bytes of a number of factors, rounded as a job rounds them: by its own search."""
    part = part_of(done)
    bound = share * done.model.squared_error_ratio * done.model.initial_energy
    found = bytes_in_file(part, allocate_bits(part, areas, bound).scales, basis, path)
    sizes, numbers = zip(*found.values(), strict=True)
    return sum(sizes) / sum(numbers)
