"""Parts with two sides in files and in the decoder."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset, check_asset
from prtbake_storage.decode.relight import facing, relight, shade
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.writer import write_asset


@pytest.fixture
def sheet(asset: Asset) -> Asset:
    """An asset whose second part is one triangle with two sides."""
    part = asset.parts[1]
    start, n = part.vertex_range[0], 6
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]], np.float32)
    up = np.tile(np.array([0.0, 1.0, 0.0], np.float32), (3, 1))
    first = np.arange(start, start + 3)
    own = asset.faces[(asset.faces < start).all(axis=1)]
    part = replace(
        part,
        vertex_range=(start, start + n),
        labels=part.labels[:n],
        weights=part.weights[:n],
        two_sided=True,
    )
    return replace(
        asset,
        positions=np.concatenate([asset.positions[:start], corners, corners]),
        normals=np.concatenate([asset.normals[:start], up, -up]),
        faces=np.concatenate([own, [first, first[::-1] + 3]]).astype(np.int32),
        uv=np.zeros((start + n, 2), np.float32),
        parts=(asset.parts[0], part),
    )


@pytest.mark.parametrize("bits", [16, 32])
def test_the_attribute_comes_back_and_is_only_there_where_it_is_so(
    sheet: Asset, tmp_path: Path, bits: int
) -> None:
    write_asset(tmp_path / "a.h5", sheet, bits=bits)
    back = read_asset(tmp_path / "a.h5")
    assert [part.two_sided for part in back.parts] == [False, True]
    n = len(sheet.faces)
    assert back.opposite is not None
    assert back.opposite[-2:].tolist() == [n - 1, n - 2]
    assert (back.opposite[:-2] == -1).all()
    with h5py.File(tmp_path / "a.h5") as file:
        assert "two_sided" not in file["parts/0"].attrs
        assert file["parts/1"].attrs["two_sided"] == 1


def test_a_file_whose_sides_do_not_match_is_refused(sheet: Asset, tmp_path: Path) -> None:
    check_asset(sheet)
    faces = sheet.faces.copy()
    faces[-1] = faces[-1][::-1]
    with pytest.raises(ValueError, match="parts/1/two_sided"):
        check_asset(replace(sheet, faces=faces))
    write_asset(tmp_path / "a.h5", sheet)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["parts/1"].attrs["two_sided"] = 2
    with pytest.raises(CorruptArtefact, match="two_sided is 2"):
        read_asset(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["parts/1"].attrs["two_sided"] = 0
        file["parts/0"].attrs["two_sided"] = 1
    with pytest.raises(CorruptArtefact, match="parts/0/two_sided"):
        read_asset(tmp_path / "a.h5")


@pytest.mark.parametrize("hit", [-2, -1])
@pytest.mark.parametrize("above", [True, False])
def test_either_copy_is_shaded_as_the_one_that_faces_the_eye(
    sheet: Asset, rng: np.random.Generator, hit: int, above: bool
) -> None:
    n = len(sheet.faces)
    triangles = np.array([n + hit, -1], np.int32)
    weights = np.array([[0.5, 0.3, 0.2], [0.0, 0.0, 0.0]])
    if hit == -1:
        weights = weights[:, ::-1].copy()
    wo = np.tile([0.0, 1.0 if above else -1.0, 0.0], (2, 1))
    found, turned = facing(sheet, triangles, weights, wo)
    assert found.tolist() == [n - 2 if above else n - 1, -1]
    assert turned[0].tolist() == ([0.5, 0.3, 0.2] if above else [0.2, 0.3, 0.5])
    radiances = relight(sheet, rng.normal(size=(sheet.n_coeffs, 3)))
    colours = shade(sheet, radiances, triangles, weights, wo)
    expected = shade(sheet, radiances, found, turned, wo)
    assert colours.any()
    assert (colours == expected).all()
    # the negative twin: with one side, the copy that was hit is black from behind
    one = replace(sheet, parts=(sheet.parts[0], replace(sheet.parts[1], two_sided=False)))
    assert shade(one, radiances, triangles, weights, wo).any() == (above == (hit == -2))
