"""What a bake hands to its bounces and they hand back: tiles by columns, blocks by rows.

Bounces do not mix coefficients, so they are made for some coefficients of all vertices; transfer is
stored vertex by vertex.  A block holds what bounces add to its coefficients, a part a group, and a
tile's share of it is read in whole chunks of vertices.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5 import schema
from prtbake_storage.hdf5.transfer import Energies

F32 = NDArray[np.float32]
I16 = NDArray[np.int16]


class Packed(NamedTuple):
    """Coefficients as int16 (verts, rows, coeffs) with a float32 scale (verts, rows)."""

    values: I16
    scale: F32


def read_transfer_tile(path: Path, columns: slice = slice(None)) -> tuple[F32, Energies]:
    """Read some coefficients of a tile that `write_transfer_tile` wrote, and its energies.

    Returns
    -------
    coefficients, energies
        (verts, terms, columns) whitened; squared radiance norms a vertex.

    Raises
    ------
    CorruptArtefact
        A checksum fails, or a dataset is missing.
    """
    with h5.open_file(path, "transfer") as tile:
        values = h5.read(h5.dataset(tile, "coefficients", "i", 3))[:, :, columns]
        verts, terms = values.shape[:2]
        scale = h5.get(tile, "scale", "f", (verts, terms))
        signal = h5.get(tile, "signal_energy", "f", (verts,))
        residual = h5.get(tile, "residual_energy", "f", (verts,))
    coefficients: F32 = values.astype(np.float32)
    coefficients *= scale[:, :, None]
    return coefficients, Energies(signal, residual)


def write_bounces(path: Path, parts: Sequence[Packed]) -> None:
    """Write what bounces add to a block of coefficients, one entry a part.

    Parameters
    ----------
    path
        Final name.
    parts
        Rows are those of transfer with its channels: channel x terms + term.
    """
    with h5.new_file(path, "bounces") as file:
        for index, packed in enumerate(parts):
            group = h5.group(file, str(index))
            rows = schema.transfer_chunk_vertices(*packed.values.shape[1:])
            added = h5.create(
                group, "added", packed.values.shape, np.dtype(np.int16), "verts rows coeffs",
                chunk_rows=min(rows, max(1, len(packed.values))),
                level=schema.TRANSFER_GZIP_LEVEL,
            )  # fmt: skip
            added[...] = packed.values
            h5.set_attribute(added, "scale", "scale")
            h5.put(group, "scale", packed.scale.astype(np.float32), "verts rows")


def read_bounces(path: Path, part: int, start: int, stop: int) -> F32:
    """Read what a block adds to vertices start..stop of a part, (verts, rows, block's coeffs).

    Raises
    ------
    CorruptArtefact
        A checksum fails, or the part is missing or smaller.
    """
    with h5.open_file(path, "bounces") as file:
        group = h5.child(file, str(part))
        added = h5.dataset(group, "added", "i", 3)
        if added.shape[0] < stop:
            raise CorruptArtefact(f"{added.name} holds {added.shape[0]} vertices, not {stop}")
        values = h5.read(added, slice(start, stop))
        scale = h5.read(h5.dataset(group, "scale", "f", 2), slice(start, stop))
    coefficients: F32 = values.astype(np.float32)
    coefficients *= scale[:, :, None]
    return coefficients
