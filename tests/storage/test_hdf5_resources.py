"""Meshes, environments and lights through HDF5."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.light import read_light
from prtbake_storage.hdf5.resources import (
    EnvironmentFile,
    MeshFile,
    read_environment,
    read_mesh,
    write_environment,
    write_mesh,
)


def unit(rng: np.random.Generator, n: int) -> np.ndarray:
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_a_mesh_comes_back_in_float64(rng: np.random.Generator, tmp_path: Path) -> None:
    mesh = MeshFile(
        rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]], np.int32), unit(rng, 5),
        rng.random((5, 2)), {"flipped": 0},
    )  # fmt: skip
    for given in (mesh, replace(mesh, uv=None)):
        write_mesh(tmp_path / "m.h5", given)
        back = read_mesh(tmp_path / "m.h5")
        np.testing.assert_array_equal(back.positions, mesh.positions)
        np.testing.assert_array_equal(back.faces, mesh.faces)
        np.testing.assert_array_equal(back.normals, mesh.normals)
        assert (back.uv is None) == (given.uv is None)
        assert back.report == {"flipped": 0}
        assert back.face_groups is None
        assert back.group_names == ()


@pytest.mark.parametrize(
    ("of_face", "names", "complaint"),
    [
        ([1, 0], ("steel", "Ångström"), None),
        ([1, 2], ("steel", "brass"), "triangle 1 names a group outside"),
        ([-1, 0], ("steel", "brass"), "triangle 0 names a group outside"),
        ([0, 1], ("steel", "steel"), "not distinct"),
        ([0, 1], ("steel", 3), "not a list of names"),
    ],
)
def test_groups_of_faces_come_back_or_are_found_wrong(
    rng: np.random.Generator, tmp_path: Path, of_face: list[int], names: tuple, complaint: str
) -> None:
    mesh = MeshFile(
        rng.normal(size=(5, 3)), np.array([[0, 1, 2], [2, 3, 4]], np.int32), unit(rng, 5), None,
        face_groups=np.array(of_face, np.int32), group_names=names,
    )  # fmt: skip
    write_mesh(tmp_path / "m.h5", mesh)
    if complaint is None:
        back = read_mesh(tmp_path / "m.h5")
        np.testing.assert_array_equal(back.face_groups, of_face)
        assert back.group_names == names
    else:
        with pytest.raises(CorruptArtefact, match=complaint):
            read_mesh(tmp_path / "m.h5")
    write_mesh(tmp_path / "m.h5", replace(mesh, faces=np.array([[0, 1, 5]], np.int32)))
    with pytest.raises(CorruptArtefact, match="/mesh/faces: triangle 0"):
        read_mesh(tmp_path / "m.h5")


def test_an_environment_comes_back(rng: np.random.Generator, tmp_path: Path) -> None:
    radiance = rng.random((8, 16, 3)).astype(np.float32)
    write_environment(tmp_path / "e.h5", EnvironmentFile(radiance, {"layout": "lat_long"}))
    back = read_environment(tmp_path / "e.h5")
    np.testing.assert_array_equal(back.radiance, radiance)
    assert back.report == {"layout": "lat_long"}
    write_environment(tmp_path / "e.h5", EnvironmentFile(-radiance))
    with pytest.raises(CorruptArtefact, match="negative"):
        read_environment(tmp_path / "e.h5")


def test_a_file_that_is_no_hdf5_is_corrupt_and_an_absent_one_is_absent(tmp_path: Path) -> None:
    (tmp_path / "x.h5").write_bytes(b"not HDF5")
    with pytest.raises(CorruptArtefact, match="no HDF5"):
        read_light(tmp_path / "x.h5")
    with pytest.raises(FileNotFoundError):
        read_light(tmp_path / "absent.h5")
