"""Transfer in tiles: the join moves bytes, whatever the number of tiles."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from prtbake_storage.decode.quantise import quantise
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import schema
from prtbake_storage.hdf5.transfer import (
    TransferHeader,
    TransferPart,
    join_transfer,
    open_transfer,
    write_transfer_tile,
)

TERMS, COEFFS = 4, 1000
CHUNK = schema.transfer_chunk_vertices(TERMS, COEFFS)


class Scene:
    """Random transfer of two parts; the last tile of each part is short."""

    def __init__(self, rng: np.random.Generator) -> None:
        sizes = (2 * CHUNK + 5, 3)
        n = sum(sizes)
        normals = rng.normal(size=(n, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        falling = (10.0 ** -np.arange(TERMS))[:, None]
        self.coefficients = [
            (rng.normal(size=(size, TERMS, COEFFS)) * falling).astype(np.float32) for size in sizes
        ]
        self.coefficients[0][1] = 0.0
        self.signal = [rng.random(size) for size in sizes]
        self.residual = [rng.random(size) for size in sizes]
        parts, start = [], 0
        for name, size in zip(("object", "receiver"), sizes, strict=True):
            parts.append(
                TransferPart(
                    name=name, vertex_range=(start, start + size), material={"model": "lambert"},
                    areas=rng.random(size), n_terms=TERMS, albedo=np.ones(1, np.float32),
                    frames=rng.normal(size=(size, 3, 3)), factorisation={"psi": np.ones((2, 2))},
                )
            )  # fmt: skip
            start += size
        self.header = TransferHeader(
            positions=rng.normal(size=(n, 3)), faces=np.array([[0, 1, 2]], np.int32),
            normals=normals, uv=None, basis=WhitenedSrbfs(np.tile([0.0, 0.0, 1.0], (COEFFS, 1)), 60.0),
            parts=tuple(parts), provenance={"seed": 1},
        )  # fmt: skip

    def tiles(self, folder: Path, size: int) -> list[list[Path]]:
        paths: list[list[Path]] = []
        for index, coefficients in enumerate(self.coefficients):
            paths.append([])
            for start in range(0, len(coefficients), size):
                block = slice(start, start + size)
                path = folder / f"tile-{size}-{index}-{start}.h5"
                packed = quantise(coefficients[block], (2,))
                write_transfer_tile(
                    path, packed.values, scale=packed.scale[:, :, 0],
                    signal_energy=self.signal[index][block],
                    residual_energy=self.residual[index][block],
                )  # fmt: skip
                paths[-1].append(path)
        return paths


def test_slices_energies_and_header_come_back(rng: np.random.Generator, tmp_path: Path) -> None:
    scene = Scene(rng)
    path = tmp_path / "t.h5"
    join_transfer(path, scene.header, scene.tiles(tmp_path, CHUNK))
    with open_transfer(path) as transfer:
        assert transfer.header.parts[1].vertex_range == scene.header.parts[1].vertex_range
        np.testing.assert_array_equal(transfer.header.positions, scene.header.positions)
        assert transfer.header.parts[0].frames is not None
        assert transfer.header.parts[0].n_terms == TERMS
        np.testing.assert_array_equal(
            transfer.header.parts[0].factorisation["psi"], np.ones((2, 2))
        )
        for part, exact in enumerate(scene.coefficients):
            whole = transfer.read(part)
            assert whole.dtype == np.float32
            step = np.abs(exact).max(axis=2, keepdims=True) / 32767
            # half a step, and 2^-8 for the scale's short mantissa
            assert (np.abs(whole - exact) <= 0.502 * step).all()
            np.testing.assert_array_equal(transfer.read(part, 1, 3), whole[1:3])
            np.testing.assert_array_equal(transfer.energies(part).signal, scene.signal[part])
            np.testing.assert_array_equal(transfer.energies(part).residual, scene.residual[part])


def test_the_number_of_tiles_does_not_change_a_byte(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    scene = Scene(rng)
    files = []
    for size in (CHUNK, 2 * CHUNK, 4 * CHUNK):
        path = tmp_path / f"t{size}.h5"
        join_transfer(path, scene.header, scene.tiles(tmp_path, size))
        files.append(path.read_bytes())
    assert files[0] == files[1] == files[2]


def test_a_tile_is_int16_with_a_scale_a_vertex_and_term(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    scene = Scene(rng)
    exact = scene.coefficients[1]
    packed = quantise(exact, (2,))
    energies = {"signal_energy": scene.signal[1], "residual_energy": scene.residual[1]}
    for values, scale in ((exact, packed.scale[:, :, 0]), (packed.values, packed.scale)):
        with pytest.raises(ValueError, match="int16"):
            write_transfer_tile(tmp_path / "a.h5", values, scale=scale, **energies)  # type: ignore[arg-type]
    assert list(tmp_path.iterdir()) == []


def test_tiles_that_do_not_fit_are_refused(rng: np.random.Generator, tmp_path: Path) -> None:
    scene = Scene(rng)
    tiles = scene.tiles(tmp_path, CHUNK)
    target = tmp_path / "t.h5"
    for wrong, message in (
        ([tiles[0][:-1], tiles[1]], "tiles hold"),
        ([[tiles[0][2], tiles[0][0], tiles[0][1]], tiles[1]], "does not start at a chunk"),
    ):
        with pytest.raises(CorruptArtefact, match=message):
            join_transfer(target, scene.header, wrong)
        assert not target.exists()


def test_a_flipped_byte_in_a_chunk_is_found_when_it_is_read(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    scene = Scene(rng)
    path = tmp_path / "t.h5"
    join_transfer(path, scene.header, scene.tiles(tmp_path, CHUNK))
    with h5py.File(path) as file:
        place = file["parts/0/coefficients"].id.get_chunk_info(1).byte_offset
    data = bytearray(path.read_bytes())
    data[place + 1000] ^= 4
    path.write_bytes(bytes(data))
    with open_transfer(path) as transfer:
        transfer.read(0, 0, CHUNK)
        with pytest.raises(CorruptArtefact, match="/parts/0/coefficients"):
            transfer.read(0, CHUNK, CHUNK + 1)


def with_channels(scene: Scene, n_channels: int, n_terms: int) -> TransferHeader:
    parts = tuple(
        replace(part, n_channels=n_channels, n_terms=n_terms) for part in scene.header.parts
    )
    return replace(scene.header, parts=parts)


def coloured_tiles(scene: Scene, folder: Path) -> list[list[Path]]:
    """The scene's terms in red, green and blue: a chunk of 4 rows a vertex is 4 of 12."""
    scene.coefficients = [
        np.concatenate([c, 0.5 * c, 0.25 * c[:, ::-1]], axis=1) for c in scene.coefficients
    ]
    return scene.tiles(folder, CHUNK)


def test_rows_of_three_channels_lie_channel_by_channel(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    scene = Scene(rng)
    path, tiles = tmp_path / "t.h5", coloured_tiles(scene, tmp_path)
    join_transfer(path, with_channels(scene, 3, TERMS), tiles)
    with open_transfer(path) as transfer:
        part = transfer.header.parts[0]
        assert (part.n_channels, part.n_terms, part.n_rows) == (3, TERMS, 3 * TERMS)
        whole = transfer.read(0)
        assert whole.shape == (part.n_vertices, 3 * TERMS, COEFFS)
        step = np.abs(scene.coefficients[0]).max(axis=2, keepdims=True) / 32767
        assert (np.abs(whole - scene.coefficients[0]) <= 0.502 * step).all()
        np.testing.assert_array_equal(transfer.read(0, 1, 3), whole[1:3])
    with h5py.File(path) as file:
        assert file["parts/0"].attrs["n_channels"] == 3
        assert file["parts/0/coefficients"].attrs["axes"] == b"verts channel*term coeffs"


def test_channels_that_do_not_fit_the_rows_are_refused(
    rng: np.random.Generator, tmp_path: Path
) -> None:
    scene = Scene(rng)
    path, plain = tmp_path / "t.h5", scene.tiles(tmp_path, CHUNK)
    with pytest.raises(CorruptArtefact, match="part 'object' has shape"):
        join_transfer(path, with_channels(scene, 3, TERMS), plain)
    with pytest.raises(ValueError, match="object: n_channels is 2"):
        join_transfer(path, with_channels(scene, 2, TERMS // 2), plain)
    assert not path.exists()
    join_transfer(path, scene.header, plain)
    for value, message in ((2, "n_channels is 2"), (3, "4 rows for n_channels 3")):
        with h5py.File(path, "r+", libver=("v110", "v110")) as file:
            file["parts/0"].attrs["n_channels"] = value
        with pytest.raises(CorruptArtefact, match=message), open_transfer(path):
            pass


def test_chunks_hold_whole_vertices_of_about_a_mebibyte() -> None:
    assert schema.transfer_chunk_vertices(16, 642) == 32
    assert schema.transfer_chunk_vertices(1, 642) == 512
    assert schema.transfer_chunk_vertices(256, 10242) == 1
    assert schema.transfer_chunk_vertices(1, 12) == 4096
