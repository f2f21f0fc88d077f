"""Subsurface scattering of one part, again and again: rows of the operator are built once and kept.

To build a row takes as long as to multiply it with hundreds of coefficients, and every bounce asks
for all of them.
"""

from dataclasses import dataclass
from os import SEEK_END
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from scipy.sparse import csr_array

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import (
    VERTICES_PER_CHUNK,
    SubsurfaceOperator,
    SubsurfaceReport,
)

KEPT_BYTES = 512 << 20
"""Rows in memory; what is more goes to a file that the system maps in as it is read."""

COLUMNS_PER_PASS = 128
"""Coefficients scattered at a time: their means over clusters take four times their own memory."""

MEASURED_ROWS = 3
"""Vertices at which every triangle is integrated, to tell what clusters and cut cost: each takes as
long as a thousand rows."""


@dataclass(frozen=True, eq=False)
class _Rows:
    """Consecutive rows: one pattern, values a channel each."""

    start: int
    indptr: Int32[I32, " rows_and_one"]
    columns: Int32[I32, " entries"]
    values: Float32[F32, "channels entries"]


class PartScattering:
    """S of one part.

    Parameters
    ----------
    scene
        The part alone (`Scene.part`): light passes inside one body.
    dipole
        Of its medium, in units of the scene.
    scratch
        Folder for rows beyond `KEPT_BYTES`, 5 to 10 kB a vertex with three channels; they stay
        in memory where it is None.
    """

    def __init__(self, scene: Scene, dipole: Dipole, *, scratch: Path | None = None) -> None:
        self.scene, self.dipole = scene, dipole
        self.operator = SubsurfaceOperator(scene, dipole)
        self._rows: list[_Rows] = []
        kept = n_clusters = n_triangles = 0
        with TemporaryFile(dir=scratch) as file:
            spill = _Spill(file)
            for start in range(0, scene.n_vertices, VERTICES_PER_CHUNK):
                rows = np.arange(start, min(start + VERTICES_PER_CHUNK, scene.n_vertices))
                block = self.operator.block(rows)
                first = block.matrices[0]
                values = np.stack([matrix.data for matrix in block.matrices])
                one = _Rows(start, first.indptr, first.indices, values)
                n_bytes = one.columns.nbytes + one.values.nbytes
                if scratch is not None and kept + n_bytes > KEPT_BYTES:
                    spill.add(one)
                else:
                    kept += n_bytes
                    self._rows.append(one)
                n_clusters += block.n_clusters
                n_triangles += block.n_triangles
            self._rows += spill.rows()
        self.report: SubsurfaceReport = self.operator.report(n_clusters, n_triangles)

    def apply(
        self, arriving: Float32[F32, "verts channels one coeffs"]
    ) -> Float32[F32, "verts channels one coeffs"]:
        """Scatter diffuse transfer, each channel by the medium's own.

        Raises
        ------
        SettingsError
            One channel for a medium of three, or transfer of more than one term.

        Notes
        -----
        Memory: the result, and some five times `COLUMNS_PER_PASS` coefficients of one channel.
        """
        n_channels, n_terms, n_coeffs = arriving.shape[1:]
        if n_terms != 1:
            raise SettingsError(f"what scatters is diffuse: it has one term, not {n_terms}")
        if n_channels < self.dipole.n_channels:
            raise SettingsError(
                f"the medium has {self.dipole.n_channels} channels, the transfer {n_channels}"
            )
        result = np.empty_like(arriving)
        for channel in range(n_channels):
            own = min(channel, self.dipole.n_channels - 1)
            for first in range(0, n_coeffs, COLUMNS_PER_PASS):
                part = slice(first, first + COLUMNS_PER_PASS)
                sources = self.operator.sources(arriving[:, channel, 0, part])
                for rows in self._rows:
                    matrix = csr_array(
                        (rows.values[own], rows.columns, rows.indptr),
                        shape=(len(rows.indptr) - 1, len(sources)),
                    )
                    stop = rows.start + matrix.shape[0]
                    result[rows.start : stop, channel, 0, part] = matrix @ sources
        return result

    def albedo(self, n_channels: int) -> Float64[F64, " channels"]:
        """Give F R of the medium in the channels of the transfer."""
        return np.broadcast_to(self.dipole.diffuse_albedo, n_channels)

    def measured_error(self, transfer: Float32[F32, "verts coeffs"], *, seed: list[int]) -> float:
        """Measure what clusters and cut cost at `MEASURED_ROWS` vertices, a squared-error ratio."""
        areas = np.maximum(self.scene.areas, 0.0)
        if not areas.any():
            return 0.0
        rng = np.random.default_rng(seed)
        rows = rng.choice(len(areas), MEASURED_ROWS, p=areas / areas.sum())
        return self.operator.measured_error(transfer, np.unique(rows))


class _Spill:
    """Rows in a file without a name, which goes when nothing maps it any more."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._added: list[tuple[int, I32, int, tuple[int, int]]] = []

    def add(self, rows: _Rows) -> None:
        """Write columns and values at the end."""
        at = self._file.tell() // rows.columns.itemsize
        self._added.append((rows.start, rows.indptr, at, rows.values.shape))
        rows.columns.tofile(self._file)
        rows.values.tofile(self._file)
        self._file.seek(0, SEEK_END)

    def rows(self) -> list[_Rows]:
        """Map all of them at once."""
        if not self._added:
            return []
        self._file.flush()
        words: I32 = np.asarray(np.memmap(self._file, np.int32, mode="r"))
        found = []
        for start, indptr, at, (n_channels, n_entries) in self._added:
            values = words[at + n_entries : at + (1 + n_channels) * n_entries].view(np.float32)
            shaped = values.reshape(n_channels, n_entries)
            found.append(_Rows(start, indptr, words[at : at + n_entries], shaped))
        return found
