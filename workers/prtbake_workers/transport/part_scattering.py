"""Subsurface scattering of one part, again and again: rows of the operator are built once and kept.

To build a row takes as long as to multiply it with hundreds of coefficients, and every bounce asks
for all of them.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from os import SEEK_END
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np
from scipy.sparse import csr_array

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import (
    MAX_SOLID_ANGLE,
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
class ScatteringRows:
    """Consecutive rows of S: one pattern, values a channel each.

    Attributes
    ----------
    start
        Vertex of the first.
    indptr, columns, values
        As `SubsurfaceBlock` has them in its matrices.
    n_clusters, n_triangles
        As `SubsurfaceBlock` counts them.
    """

    start: int
    indptr: Int32[I32, " rows_and_one"]
    columns: Int32[I32, " entries"]
    values: Float32[F32, "channels entries"]
    n_clusters: int
    n_triangles: int

    @property
    def stop(self) -> int:
        """Vertex after the last."""
        return self.start + len(self.indptr) - 1

    @property
    def n_bytes(self) -> int:
        """Of columns and values."""
        return self.columns.nbytes + self.values.nbytes


def build_rows(
    operator: SubsurfaceOperator,
    start: int,
    stop: int,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> ScatteringRows:
    """Build the rows of vertices start..stop.

    Parameters
    ----------
    operator
        Of the part alone.
    start, stop
        Numbers within the part.
    progress
        Called with vertices done and vertices to do.
    """
    found = []
    for first in range(start, stop, VERTICES_PER_CHUNK):
        last = min(first + VERTICES_PER_CHUNK, stop)
        block = operator.block(np.arange(first, last))
        pattern = block.matrices[0]
        values = np.stack([matrix.data for matrix in block.matrices])
        counts = block.n_clusters, block.n_triangles
        found.append(ScatteringRows(first, pattern.indptr, pattern.indices, values, *counts))
        if progress is not None:
            progress(last - start, stop - start)
    ends = np.cumsum([0, *(len(one.columns) for one in found)])
    starts = [one.indptr[:-1] + end for one, end in zip(found, ends[:-1], strict=True)]
    return ScatteringRows(
        start,
        np.concatenate([*starts, ends[-1:]]).astype(np.int32),
        np.concatenate([one.columns for one in found]),
        np.concatenate([one.values for one in found], axis=1),
        sum(one.n_clusters for one in found),
        sum(one.n_triangles for one in found),
    )


class PartScattering:
    """S of one part.

    Parameters
    ----------
    scene
        The part alone (`Scene.part`): light passes inside one body.
    dipole
        Of its medium, in units of the scene.
    rows
        All of them in any runs, from an operator of the same arguments; None to build them.
    max_solid_angle
        As `SubsurfaceOperator` takes it.
    scratch
        Folder for rows beyond `KEPT_BYTES`, 3 to 10 kB a vertex with three channels; they stay
        in memory where it is None.

    Raises
    ------
    SettingsError
        Rows of another number of vertices, channels or clusters.
    """

    def __init__(
        self,
        scene: Scene,
        dipole: Dipole,
        *,
        rows: Iterable[ScatteringRows] | None = None,
        max_solid_angle: float = MAX_SOLID_ANGLE,
        scratch: Path | None = None,
    ) -> None:
        self.scene, self.dipole = scene, dipole
        self.operator = SubsurfaceOperator(scene, dipole, max_solid_angle=max_solid_angle)
        if rows is None:
            rows = _built(self.operator)
        self._rows: list[ScatteringRows] = []
        kept = 0
        with TemporaryFile(dir=scratch) as file:
            spill = _Spill(file)
            for one in rows:
                if scratch is not None and kept + one.n_bytes > KEPT_BYTES:
                    spill.add(one)
                else:
                    kept += one.n_bytes
                    self._rows.append(one)
            self._rows += spill.rows()
        self._check()
        self._matrices = [[self._matrix(one, own) for own in one.values] for one in self._rows]
        self.report: SubsurfaceReport = self.operator.report(
            sum(one.n_clusters for one in self._rows), sum(one.n_triangles for one in self._rows)
        )

    def _check(self) -> None:
        n_verts = sum(one.stop - one.start for one in self._rows)
        if n_verts != self.scene.n_vertices:
            raise SettingsError(f"rows of {n_verts} vertices for {self.scene.n_vertices}")
        expected = 0
        for one in self._rows:
            if one.start != expected:
                raise SettingsError(
                    f"rows of vertex {one.start} where those of {expected} should be"
                )
            expected = one.stop
        n_sources = self.scene.n_vertices + self.operator.tree.n_nodes
        for one in self._rows:
            if len(one.values) != self.dipole.n_channels or one.columns.max(initial=0) >= n_sources:
                raise SettingsError(f"rows {one.start} to {one.stop} are those of another operator")

    def _matrix(self, rows: ScatteringRows, values: Float32[F32, " entries"]) -> Any:
        shape = (rows.stop - rows.start, self.scene.n_vertices + self.operator.tree.n_nodes)
        matrix = csr_array(shape, dtype=np.float32)
        # given to the constructor, one channel of three or of a file would be copied
        matrix.data, matrix.indices, matrix.indptr = values, rows.columns, rows.indptr
        return matrix

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
                for rows, matrices in zip(self._rows, self._matrices, strict=True):
                    scattered = matrices[own] @ sources
                    result[rows.start : rows.stop, channel, 0, part] = scattered
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
        drawn = rng.choice(len(areas), MEASURED_ROWS, p=areas / areas.sum())
        rows, counts = np.unique(drawn, return_counts=True)
        return self.operator.measured_error(transfer, rows, counts.astype(np.float64))


def _built(operator: SubsurfaceOperator) -> Iterable[ScatteringRows]:
    n_verts = operator.scene.n_vertices
    for start in range(0, n_verts, VERTICES_PER_CHUNK):
        yield build_rows(operator, start, min(start + VERTICES_PER_CHUNK, n_verts))


class _Spill:
    """Rows in a file without a name, which goes when nothing maps it any more."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file = file
        self._added: list[tuple[int, ScatteringRows]] = []

    def add(self, rows: ScatteringRows) -> None:
        """Write columns and values at the end."""
        at = self._file.tell() // rows.columns.itemsize
        rows.columns.tofile(self._file)
        rows.values.tofile(self._file)
        self._file.seek(0, SEEK_END)
        nothing = np.empty(0, np.int32), np.empty((len(rows.values), 0), np.float32)
        self._added.append((at, replace(rows, columns=nothing[0], values=nothing[1])))

    def rows(self) -> list[ScatteringRows]:
        """Map all of them at once."""
        if not self._added:
            return []
        self._file.flush()
        words: I32 = np.asarray(np.memmap(self._file, np.int32, mode="r"))
        found = []
        for at, one in self._added:
            n_channels, n_entries = len(one.values), int(one.indptr[-1])
            values = words[at + n_entries : at + (1 + n_channels) * n_entries].view(np.float32)
            shaped = values.reshape(n_channels, n_entries)
            found.append(replace(one, columns=words[at : at + n_entries], values=shaped))
        return found
