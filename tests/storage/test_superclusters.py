"""Index buffers of superclusters through HDF5."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset
from prtbake_storage.decode.superclusters import Superclusters, draws
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.writer import write_asset

PAIRS = np.array([0, 1, 0, 1], np.int32)


@pytest.fixture
def grouped(asset: Asset) -> Asset:
    """The shared asset, its second part drawn in two groups of two clusters."""
    part = asset.parts[1]
    faces = asset.faces_of(1)
    drawn = draws(faces, PAIRS[part.labels])
    groups = Superclusters(
        registers=12,
        of_cluster=PAIRS,
        indices=faces[drawn.triangles] + np.int32(part.vertex_range[0]),
        starts=drawn.starts,
    )
    return replace(asset, parts=(asset.parts[0], replace(part, superclusters=groups)))


@pytest.mark.parametrize("bits", [16, 32])
def test_they_come_back_as_they_were(grouped: Asset, tmp_path: Path, bits: int) -> None:
    write_asset(tmp_path / "a.h5", grouped, bits=bits)
    back = read_asset(tmp_path / "a.h5")
    assert back.parts[0].superclusters is None
    found, written = back.parts[1].superclusters, grouped.parts[1].superclusters
    assert found is not None
    assert written is not None
    assert found.registers == 12
    for name in ("of_cluster", "indices", "starts"):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    assert back.parts[1].nbytes["superclusters"] == found.nbytes > 0
    drawn = len(found.indices) / len(back.faces_of(1))
    assert 1.0 <= drawn <= back.overdraw_of(1)


def test_an_asset_without_them_is_the_file_it_was(
    asset: Asset, grouped: Asset, tmp_path: Path
) -> None:
    write_asset(tmp_path / "a.h5", asset)
    with h5py.File(tmp_path / "a.h5") as file:
        assert "superclusters" not in file["parts/1"]
    write_asset(tmp_path / "b.h5", grouped)
    with h5py.File(tmp_path / "b.h5") as file:
        assert set(file["parts/1/superclusters"]) == {"of_cluster", "indices", "starts"}


@pytest.mark.parametrize(
    ("name", "spoil", "message"),
    [
        ("of_cluster", lambda a: 1 - a, "superclusters/(starts|indices)"),
        ("of_cluster", np.zeros_like, "of_cluster does not use 0 to 1"),
        ("indices", lambda a: a[:, ::-1], "superclusters/indices"),
        ("starts", lambda a: a + (np.arange(len(a)) == 1), "superclusters/starts"),
    ],
)
def test_index_buffers_that_do_not_fit_the_labels_are_refused(
    grouped: Asset, tmp_path: Path, name: str, spoil: object, message: str
) -> None:
    write_asset(tmp_path / "a.h5", grouped)
    assert callable(spoil)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        data = file[f"parts/1/superclusters/{name}"]
        data[...] = spoil(data[...])
    with pytest.raises(CorruptArtefact, match=message):
        read_asset(tmp_path / "a.h5")


def test_a_register_count_that_is_none_is_refused(grouped: Asset, tmp_path: Path) -> None:
    write_asset(tmp_path / "a.h5", grouped)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["parts/1/superclusters"].attrs["registers"] = "many"
    with pytest.raises(CorruptArtefact, match="registers is 'many'"):
        read_asset(tmp_path / "a.h5")
