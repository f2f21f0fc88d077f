"""Raw transfer: a header, and 16-bit coefficients written in tiles by many processes.

A coefficient is int16 times a float32 scale of its vertex and row.  A row is a term, or where
transfer has three channels a term of one of them: row c * terms + k.  A chunk holds whole vertices;
tiles begin at multiples of it, so that the join moves compressed chunks as they are.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import Surface
from prtbake_storage.decode.transfer_basis import TransferBasis
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5 import schema
from prtbake_storage.hdf5.basis import get_basis, put_basis
from prtbake_storage.hdf5.resources import get_mesh, put_mesh
from prtbake_storage.hdf5.tables import child_parts, get_surface, put_surface

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]

PER_VERTEX = {"scale": "verts channel*term", "signal_energy": "verts", "residual_energy": "verts"}


@dataclass(frozen=True, kw_only=True)
class TransferPart(Surface):
    """All of a part but its coefficients.

    ``areas`` (verts,) weigh errors over the surface; ``frames`` (verts, 3, 3) or None for a
    constant phi; ``n_terms`` the terms K of the BRDF's factorisation, whatever ``n_channels``;
    ``subsurface`` what scatters inside, as requests say it, or None.
    """

    areas: F64
    n_terms: int
    frames: F64 | None = None
    subsurface: Mapping[str, Any] | None = None

    @property
    def n_rows(self) -> int:
        """Rows of coefficients a vertex has: its terms, channel by channel."""
        return self.n_channels * self.n_terms


@dataclass(frozen=True, kw_only=True)
class TransferHeader:
    """The scene, the basis and the parts that transfer was simulated for."""

    positions: F64
    faces: I32
    normals: F64
    uv: F64 | None
    basis: TransferBasis
    parts: tuple[TransferPart, ...]
    provenance: Mapping[str, Any] = field(default_factory=dict)


class Energies(NamedTuple):
    """Squared radiance norms a vertex (verts,): of the signal, and of what projection left out.

    Sums over all rows: three channels count as three signals.
    """

    signal: F64
    residual: F64


def write_transfer_tile(
    path: Path, coefficients: I16, *, scale: F32, signal_energy: F64, residual_energy: F64
) -> None:
    """Write one tile: a block of vertices of one part.

    Parameters
    ----------
    path
        Final name.
    coefficients
        (verts, rows, coeffs) int16, those of an orthonormal basis when multiplied by ``scale``.
    scale
        (verts, rows).
    signal_energy, residual_energy
        (verts,) squared radiance norms.
    """
    if coefficients.dtype != np.int16 or scale.shape != coefficients.shape[:2]:
        raise ValueError("coefficients must be int16 with a (verts, rows) scale")
    with h5.new_file(path, "transfer") as file:
        target = _create_coefficients(file, coefficients.shape)
        target[...] = coefficients
        _put_vertex_data(file, scale.astype(np.float32), signal_energy, residual_energy)


def join_transfer(path: Path, header: TransferHeader, tiles: Sequence[Sequence[Path]]) -> None:
    """Join tiles into one transfer file without compressing again.

    Parameters
    ----------
    path
        Final name.
    header
        What the coefficients belong to.
    tiles
        For every part the paths of its tiles, in the order of their vertices; every tile but a
        part's last holds a multiple of `schema.transfer_chunk_vertices` vertices.

    Raises
    ------
    CorruptArtefact
        A tile is damaged or does not fit.
    """
    with h5.new_file(path, "transfer") as file:
        put_mesh(file, header.positions, header.faces, header.normals, header.uv)
        put_basis(file, header.basis)
        parts = h5.group(file, "parts")
        for index, (part, paths) in enumerate(zip(header.parts, tiles, strict=True)):
            group = h5.group(parts, str(index))
            put_surface(group, part)
            h5.put(group, "areas", part.areas.astype(np.float64), "verts", unit="scene^2")
            if part.frames is not None:
                h5.put(group, "frames", part.frames.astype(np.float64), "verts axes xyz")
            if part.subsurface is not None:
                h5.put_json(group, "subsurface", dict(part.subsurface))
            _join_part(group, part, header.basis.n_coeffs, paths)
        h5.put_json(file, "provenance", dict(header.provenance))


def unpacked(values: I16, scale: F32) -> F32:
    """Return float32 coefficients (verts, rows, coeffs) of 16-bit ones and their scale."""
    coefficients: F32 = values.astype(np.float32)
    coefficients *= scale[:, :, None]
    return coefficients


class TransferFile:
    """An open transfer file: header at once, coefficients in slices."""

    def __init__(self, header: TransferHeader, groups: list[h5py.Group]) -> None:
        self.header = header
        self._groups = groups

    def read(self, part: int, start: int = 0, stop: int | None = None) -> F32:
        """Return float32 coefficients of vertices start..stop, counted in the part.

        Shape (verts, rows, coeffs).  Raises CorruptArtefact where a checksum fails.
        """
        return unpacked(*self.read_packed(part, start, stop))

    def read_packed(self, part: int, start: int = 0, stop: int | None = None) -> tuple[I16, F32]:
        """Return the same as it is stored: int16 (verts, rows, coeffs), and its scale."""
        values = h5.read(self._groups[part]["coefficients"], slice(start, stop))
        return values, h5.read(self._groups[part]["scale"], slice(start, stop))

    def energies(self, part: int) -> Energies:
        """Return the squared radiance norms a vertex."""
        group = self._groups[part]
        return Energies(h5.read(group["signal_energy"]), h5.read(group["residual_energy"]))


@contextmanager
def open_transfer(path: Path) -> Iterator[TransferFile]:
    """Open a transfer file and check everything but the coefficients' own checksums.

    Raises
    ------
    CorruptArtefact
        Naming the dataset that is damaged, missing or not what the schema says.
    """
    with h5.open_file(path, "transfer") as file:
        positions, faces, normals, uv = get_mesh(file)
        basis = get_basis(file)
        groups = child_parts(file)
        header = TransferHeader(
            positions=positions,
            faces=faces,
            normals=normals,
            uv=uv,
            basis=basis,
            parts=tuple(_get_part(group, basis.n_coeffs) for group in groups),
            provenance=h5.get_object(file, "provenance"),
        )
        ranges = [part.vertex_range for part in header.parts]
        ends = [0, *(stop for _, stop in ranges)]
        if [start for start, _ in ranges] != ends[:-1] or ends[-1] != len(positions):
            raise CorruptArtefact(f"/parts: ranges {ranges} do not cover {len(positions)} vertices")
        yield TransferFile(header, groups)


def _get_part(group: h5py.Group, n_coeffs: int) -> TransferPart:
    surface = get_surface(group)
    start, stop = surface["vertex_range"]
    verts = stop - start
    coefficients = h5.dataset(group, "coefficients", "i", 3)
    n_rows = coefficients.shape[1]
    if coefficients.dtype != np.int16 or coefficients.shape != (verts, n_rows, n_coeffs):
        raise CorruptArtefact(
            f"{coefficients.name} is {coefficients.dtype} {coefficients.shape}, "
            f"not int16 {(verts, n_rows, n_coeffs)}"
        )
    n_channels = surface["n_channels"]
    n_terms, left = divmod(n_rows, n_channels)
    if left:
        raise CorruptArtefact(
            f"{coefficients.name} has {n_rows} rows for n_channels {n_channels}: no whole terms"
        )
    for name, axes in PER_VERTEX.items():
        h5.get(group, name, "f", (verts, n_rows)[: len(axes.split())])
    areas = h5.get(group, "areas", "f", (verts,)).astype(np.float64)
    frames = None
    if h5.has(group, "frames"):
        frames = h5.get(group, "frames", "f", (verts, 3, 3)).astype(np.float64)
    medium = h5.get_object(group, "subsurface") if h5.has(group, "subsurface") else None
    return TransferPart(**surface, areas=areas, n_terms=n_terms, frames=frames, subsurface=medium)


def _stored_chunk(source: h5py.Dataset, start: int) -> tuple[int, bytes]:
    try:
        mask, chunk = source.id.read_direct_chunk((start, 0, 0))
    except (OSError, RuntimeError) as error:
        raise CorruptArtefact(f"{source.name} lacks its chunk at vertex {start}") from error
    return int(mask), chunk


def _create_coefficients(group: h5py.Group, shape: tuple[int, ...]) -> h5py.Dataset:
    chunk_verts = schema.transfer_chunk_vertices(shape[1], shape[2])
    target = h5.create(
        group, "coefficients", shape, np.dtype(np.int16), "verts channel*term coeffs",
        chunk_rows=chunk_verts, growing=True, level=schema.TRANSFER_GZIP_LEVEL,
    )  # fmt: skip
    h5.set_attribute(target, "scale", "scale")
    return target


def _put_vertex_data(group: h5py.Group, scale: F32, signal: F64, residual: F64) -> None:
    h5.put(group, "scale", scale, PER_VERTEX["scale"])
    h5.put(group, "signal_energy", signal.astype(np.float64), "verts")
    h5.put(group, "residual_energy", residual.astype(np.float64), "verts")


def _join_part(group: h5py.Group, part: TransferPart, n_coeffs: int, paths: Sequence[Path]) -> None:
    shape = (part.n_vertices, part.n_rows, n_coeffs)
    target = _create_coefficients(group, shape)
    chunk_verts = schema.transfer_chunk_vertices(part.n_rows, n_coeffs)
    vertex_data: dict[str, list[NDArray[Any]]] = {name: [] for name in PER_VERTEX}
    start = 0
    for path in paths:
        with h5.open_file(path, "transfer") as tile:
            source = h5.dataset(tile, "coefficients", "i", 3)
            if source.shape[1:] != shape[1:] or source.chunks != target.chunks:
                raise CorruptArtefact(
                    f"tile at vertex {start} of part {part.name!r} has shape {source.shape}"
                )
            if start % chunk_verts:
                raise CorruptArtefact(
                    f"tile at vertex {start} does not start at a chunk of {chunk_verts}"
                )
            count = source.shape[0]
            for offset in range(0, count, chunk_verts):
                mask, chunk = _stored_chunk(source, offset)
                target.id.write_direct_chunk((start + offset, 0, 0), chunk, mask)
            for name, axes in PER_VERTEX.items():
                expected = (count, part.n_rows)[: len(axes.split())]
                vertex_data[name].append(h5.get(tile, name, "f", expected))
        start += count
    if start != part.n_vertices:
        raise CorruptArtefact(
            f"tiles hold {start} vertices of part {part.name!r}, not {part.n_vertices}"
        )
    joined = {name: np.concatenate(pieces) for name, pieces in vertex_data.items()}
    _put_vertex_data(group, joined["scale"], joined["signal_energy"], joined["residual_energy"])
