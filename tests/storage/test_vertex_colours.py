"""Vertex colours in files and in the decoder: kept bit for bit, interpolated at the pixel."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset, check_asset
from prtbake_storage.decode.relight import relight, shade
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.reader import read_asset
from prtbake_storage.hdf5.resources import MeshFile, read_mesh, write_mesh
from prtbake_storage.hdf5.writer import write_asset


@pytest.fixture
def tinted(asset: Asset, rng: np.random.Generator) -> Asset:
    """An asset whose second part has vertex colours beside its texture."""
    part = asset.parts[1]
    colours = rng.random((part.n_vertices, 3)).astype(np.float32)
    return replace(asset, parts=(asset.parts[0], replace(part, vertex_colours=colours)))


def test_those_of_a_mesh_come_back_bit_for_bit(rng: np.random.Generator, tmp_path: Path) -> None:
    positions = rng.normal(size=(4, 3))
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    colours = rng.random((4, 3)).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    mesh = MeshFile(positions, faces, normals, None, {}, colours)
    write_mesh(tmp_path / "m.h5", mesh)
    back = read_mesh(tmp_path / "m.h5").colours
    assert back is not None
    assert back.tobytes() == colours.tobytes()
    write_mesh(tmp_path / "m.h5", replace(mesh, colours=None))
    assert read_mesh(tmp_path / "m.h5").colours is None


@pytest.mark.parametrize("bits", [16, 32])
def test_those_of_an_asset_are_not_rounded(tinted: Asset, tmp_path: Path, bits: int) -> None:
    seen = write_asset(tmp_path / "a.h5", tinted, bits=bits)
    back = read_asset(tmp_path / "a.h5")
    assert back.parts[0].vertex_colours is None
    for found in (seen, back):
        colours, given = found.parts[1].vertex_colours, tinted.parts[1].vertex_colours
        assert colours is not None
        assert given is not None
        assert colours.tobytes() == given.tobytes()


def test_their_bytes_are_counted(asset: Asset, tinted: Asset) -> None:
    part = tinted.parts[1]
    assert part.nbytes["vertex_colours"] == 12 * part.n_vertices
    assert asset.nbytes["vertex_colours"] == 0
    assert sum(tinted.nbytes.values()) - sum(asset.nbytes.values()) == 12 * part.n_vertices


@pytest.mark.parametrize("value", [-0.01, 1.01, np.nan, np.inf])
def test_a_file_with_broken_ones_is_refused(tinted: Asset, tmp_path: Path, value: float) -> None:
    path = tmp_path / "a.h5"
    write_asset(path, tinted)
    with h5py.File(path, "r+") as file:
        file["parts/1/vertex_colours"][2, 1] = value
    with pytest.raises(CorruptArtefact, match=r"/parts/1/vertex_colours.*(vertex 2|\(2, 1\))"):
        read_asset(path)


def test_an_asset_with_wrong_ones_is_not_written(tinted: Asset) -> None:
    part = tinted.parts[1]
    assert part.vertex_colours is not None
    short = replace(part, vertex_colours=part.vertex_colours[1:])
    with pytest.raises(ValueError, match="parts/1/vertex_colours has shape"):
        check_asset(replace(tinted, parts=(tinted.parts[0], short)))
    bright = replace(part, vertex_colours=part.vertex_colours + np.float32(1))
    with pytest.raises(ValueError, match=r"parts/1/vertex_colours is 1\.\d+ at \(0, 0\)"):
        check_asset(replace(tinted, parts=(tinted.parts[0], bright)))


def test_shading_equals_its_slow_twin(tinted: Asset, rng: np.random.Generator) -> None:
    """Pixel by pixel in float64: albedo, texture and colours multiply what is reflected."""
    part = tinted.parts[1]
    assert part.vertex_colours is not None
    start, _ = part.vertex_range
    radiances = relight(tinted, rng.normal(size=(tinted.n_coeffs, 3)))
    own = np.flatnonzero((tinted.faces >= start).all(axis=1))
    triangles = rng.choice(own, 40).astype(np.int32)
    weights = rng.dirichlet(np.ones(3), 40)
    corners = tinted.faces[triangles]
    a, b, c = (tinted.positions[corners[:, i]].astype(np.float64) for i in range(3))
    normal = np.cross(b - a, c - a)
    shading = tinted.normals[corners].sum(axis=1)
    wo = normal * np.sign((normal * shading).sum(axis=1, keepdims=True))
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    query = (triangles, weights, wo)
    found = shade(tinted, radiances, *query)
    bare = replace(tinted, parts=(tinted.parts[0], replace(part, vertex_colours=None)))
    base = shade(bare, radiances, *query)
    nearest = np.empty_like(base)
    for pixel in range(40):
        tint = np.zeros(3)
        for corner in range(3):
            vertex = corners[pixel, corner] - start
            tint += weights[pixel, corner] * part.vertex_colours[vertex].astype(np.float64)
        # products and sums of a few float32 numbers
        np.testing.assert_allclose(found[pixel], base[pixel] * tint, rtol=2e-6)
        nearest[pixel] = part.vertex_colours[corners[pixel, 0] - start]
    # the negative twins: the colour of one corner, and those of the next vertices
    assert np.abs(found - base * nearest).max() > 0.01 * np.abs(base).max()
    rolled = replace(part, vertex_colours=np.roll(part.vertex_colours, 1, axis=0))
    wrong = shade(replace(tinted, parts=(tinted.parts[0], rolled)), radiances, *query)
    assert np.abs(found - wrong).max() > 0.01 * np.abs(base).max()
