"""Transfer of one part as raw 16-bit rows in a file, read vertex by vertex at the speed of a disk.

A transfer file holds chunks of vertices, compressed: fine to read in order, slow for the members
of a cluster, which lie anywhere.  Unpacked once, rows are read where they lie, and memory holds
what is asked for, and a scale a row.
"""

import os
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.hdf5.transfer import TransferFile, unpacked
from prtbake_workers.arrays import F32, Float32

WRITTEN_VERTS = 512
"""Vertices unpacked at a time."""


class RowsFile:
    """float32 coefficients (verts, rows, coeffs) of a file of int16 ones.

    Parameters
    ----------
    path
        int16 (verts, rows, coeffs), nothing else.
    scale
        Of each vertex and row.
    n_coeffs
        Coefficients of a row.

    Raises
    ------
    ValueError
        The file is not of this size.
    """

    def __init__(self, path: Path, scale: Float32[F32, "verts rows"], n_coeffs: int) -> None:
        self.scale, self.shape = scale, (*scale.shape, n_coeffs)
        self.nbytes = 4 * scale.size * n_coeffs
        self._row_bytes = 2 * scale.shape[1] * n_coeffs
        if path.stat().st_size != self._row_bytes * len(scale):
            raise ValueError(f"{path.name} does not hold rows of the shape {self.shape}")
        self._path = path

    def __len__(self) -> int:
        return len(self.scale)

    def __getitem__(self, verts: slice | NDArray[Any], /) -> Float32[F32, "verts rows coeffs"]:
        """Return the coefficients of a slice without a step, or of indices in any order."""
        if isinstance(verts, slice):
            start, stop, _ = verts.indices(len(self))
            runs = [(start, max(start, stop))]
        else:
            runs = _runs(verts)
        values = np.empty((sum(b - a for a, b in runs), *self.shape[1:]), dtype=np.int16)
        done = 0
        with self._path.open("rb", buffering=0) as file:
            for start, stop in runs:
                self._read(file, values[done : done + stop - start], start)
                done += stop - start
        return unpacked(values, self.scale[verts])

    def _read(self, file: FileIO, values: NDArray[np.int16], start: int) -> None:
        """Fill whole rows from the file."""
        left = values.reshape(-1).view(np.uint8).data
        at = start * self._row_bytes
        while left:
            count = os.preadv(file.fileno(), [left], at)
            if count == 0:
                raise OSError(f"{self._path.name} ends at byte {at}")
            left, at = left[count:], at + count


def _runs(verts: NDArray[Any]) -> list[tuple[int, int]]:
    """Cut indices into (start, stop) of neighbours that lie one after the other."""
    if len(verts) == 0:
        return []
    cuts = np.flatnonzero(np.diff(verts) != 1) + 1
    starts, ends = verts[np.append(0, cuts)], verts[np.append(cuts, len(verts)) - 1]
    return list(zip(starts.tolist(), (ends + 1).tolist(), strict=True))


def write_rows(path: Path, transfer: TransferFile, part: int) -> RowsFile:
    """Unpack a part of a transfer file into ``path``; return what reads it there."""
    own = transfer.header.parts[part]
    scale = np.empty((own.n_vertices, own.n_rows), dtype=np.float32)
    with path.open("wb") as file:
        for start in range(0, own.n_vertices, WRITTEN_VERTS):
            stop = min(start + WRITTEN_VERTS, own.n_vertices)
            values, scale[start:stop] = transfer.read_packed(part, start, stop)
            file.write(values.tobytes())
    return RowsFile(path, scale, transfer.header.basis.n_coeffs)
