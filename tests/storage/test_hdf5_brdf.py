"""Measured BRDFs through HDF5."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.brdf import BrdfFile, read_brdf, write_brdf


@pytest.fixture
def table(rng: np.random.Generator) -> np.ndarray:
    return rng.random((5, 4, 3, 3)).astype(np.float32)


def test_a_table_comes_back(table: np.ndarray, tmp_path: Path) -> None:
    write_brdf(tmp_path / "b.h5", BrdfFile("half_difference", {"values": table}, {"n_invalid": 3}))
    back = read_brdf(tmp_path / "b.h5")
    assert (back.parametrisation, back.report) == ("half_difference", {"n_invalid": 3})
    np.testing.assert_array_equal(back.arrays["values"], table)
    assert back.arrays["values"].dtype == np.float32


ISOTROPIC = {
    "theta_i": (4,), "sigma": (6,), "ndf": (3, 6), "vndf": (4, 3, 6), "rgb": (4, 5, 5, 3),
}  # fmt: skip
ORIENTED = {
    "phi_i": (5,), "theta_i": (4,), "sigma": (3, 6), "ndf": (3, 6), "vndf": (5, 4, 3, 6),
    "rgb": (5, 4, 7, 7, 3),
}  # fmt: skip


@pytest.mark.parametrize(("kind", "shapes"), [("rgl", ISOTROPIC), ("rgl_oriented", ORIENTED)])
def test_every_array_of_a_tensor_file_comes_back(
    rng: np.random.Generator, tmp_path: Path, kind: str, shapes: dict[str, tuple[int, ...]]
) -> None:
    arrays = {name: rng.random(shape).astype(np.float32) for name, shape in shapes.items()}
    write_brdf(tmp_path / "b.h5", BrdfFile(kind, arrays))
    back = read_brdf(tmp_path / "b.h5")
    assert set(back.arrays) == set(arrays)
    for name, array in arrays.items():
        np.testing.assert_array_equal(back.arrays[name], array)


def test_equal_content_is_equal_bytes(table: np.ndarray, tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_brdf(tmp_path / name, BrdfFile("half_difference", {"values": table}))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_what_is_damaged_is_named(table: np.ndarray, tmp_path: Path) -> None:
    path = tmp_path / "b.h5"
    write_brdf(path, BrdfFile("half_difference", {"values": table}))
    with h5py.File(path, "r+") as file:
        file["brdf"].attrs["parametrisation"] = "spherical"
    with pytest.raises(CorruptArtefact, match="spherical"):
        read_brdf(path)
    write_brdf(path, BrdfFile("half_difference", {"values": np.full_like(table, np.nan)}))
    with pytest.raises(CorruptArtefact, match="/brdf/values is not finite"):
        read_brdf(path)
    with pytest.raises(ValueError, match="do not name"):
        write_brdf(path, BrdfFile("half_difference", {"values": table[0]}))
