"""The SDK's relighting against the formulas written out vertex by vertex."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prtbake import Asset
from prtbake_storage.decode.asset import Asset as Arrays
from prtbake_storage.decode.asset import Part
from prtbake_storage.decode.light import LightFit
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5.light import write_light
from prtbake_storage.hdf5.writer import write_asset

VERTS, COEFFS, BANDWIDTH = 6, 12, 4.0
POSITIONS = np.vstack([np.eye(3), -np.eye(3)])
FACES = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]


def unit(rng: np.random.Generator, count: int) -> np.ndarray:
    vectors = rng.normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.fixture
def asset(rng: np.random.Generator) -> Asset:
    """An octahedron with one CTA part of two clusters and a view texture that is 1."""
    normals = POSITIONS.astype(np.float32)
    tangents = np.roll(normals, 1, axis=1)
    frames = np.stack([tangents, np.cross(normals, tangents), normals], axis=1)
    f32 = np.float32
    part = Part(
        name="object",
        vertex_range=(0, VERTS),
        material={"model": "ggx"},
        method="cta",
        labels=np.array([0, 1, 0, 1, 1, 0], np.int32),
        weights=rng.normal(size=(VERTS, 3)).astype(f32),
        albedo=np.array([0.9, 0.5, 0.2], f32),
        ranks=np.array([[2, 4, 3], [2, 4, 3]], np.int32),
        view_basis=np.linalg.qr(rng.normal(size=(5, 2)))[0].astype(f32),
        view_texture=np.ones((4, 4, 2, 1), f32),
        light_bases=rng.normal(size=(2, COEFFS, 4)).astype(f32),
        dual_bases=rng.normal(size=(2, 3, 8)).astype(f32),
        frames=frames.astype(f32),
    )
    return Asset(
        Arrays(
            positions=normals,
            faces=np.array(FACES, np.int32),
            normals=normals,
            uv=None,
            parts=(part,),
            basis=WhitenedSrbfs(unit(rng, COEFFS), BANDWIDTH),
        )
    )


@pytest.fixture
def light(rng: np.random.Generator) -> LightFit:
    return LightFit(
        centres=unit(rng, 5),
        bandwidths=rng.uniform(1, 8, 5),
        coefficients=rng.uniform(0, 1, (5, 3)),
        error=0.0,
    )


def by_hand(asset: Asset, light: LightFit, rotation: np.ndarray) -> np.ndarray:
    """Tsai & Shih 2006, eqs. (18) and (22), one vertex and one sum after the other."""
    data, part = asset.data, asset.data.parts[0]

    def overlap(a: np.ndarray, lam_a: float, b: np.ndarray, lam_b: float) -> float:
        # the product of two Gaussians is one of |lam_a a + lam_b b|: 4 pi sinh(r) / r
        r = np.linalg.norm(lam_a * a + lam_b * b)
        return float(4 * np.pi * np.exp(-(lam_a + lam_b)) * np.sinh(r) / r)

    gram = np.array(
        [
            [overlap(a, BANDWIDTH, b, BANDWIDTH) for b in data.basis.centres]
            for a in data.basis.centres
        ]
    )
    values, vectors = np.linalg.eigh(gram)
    root = vectors @ np.diag(values**-0.5) @ vectors.T
    seen = np.zeros((COEFFS, 3))
    for i, centre in enumerate(data.basis.centres):
        for lobe, lam, colour in zip(
            light.centres, light.bandwidths, light.coefficients, strict=True
        ):
            seen[i] += overlap(centre, BANDWIDTH, rotation @ lobe, lam) * colour
    whitened = root @ seen
    colours = np.zeros((VERTS, 3))
    for vertex in range(VERTS):
        cluster = part.labels[vertex]
        transfer = np.zeros((2, COEFFS))
        for j in range(3):
            core = part.dual_bases[cluster, j].reshape(2, 4).astype(float)
            transfer += part.weights[vertex, j] * core @ part.light_bases[cluster].T
        colours[vertex] = (transfer @ whitened).sum(axis=0) * part.albedo
    return colours


@pytest.mark.parametrize("rotation", [None, (10.0, 70.0, -30.0)])
def test_vertex_radiance(asset: Asset, light: LightFit, rotation) -> None:
    eye = np.array([3.0, 4.0, 5.0])
    colours = asset.vertex_radiance(eye, light, rotation=rotation)
    turned = np.eye(3) if rotation is None else rotation_matrix(rotation)
    expected = by_hand(asset, light, turned)
    facing = POSITIONS @ eye > 1  # n . (eye - p) with n = p of length 1
    # float32 factors of order 10 summed over 12 coefficients: measured worst 3e-6
    np.testing.assert_allclose(colours[facing], expected[facing], rtol=1e-4, atol=1e-4)
    assert (colours[~facing] == 0).all()
    assert facing.any()
    assert not facing.all()
    # the twin that must fail: the light turned the other way
    wrong = by_hand(asset, light, rotation_matrix((0.0, 40.0, 0.0)) @ turned)
    assert not np.allclose(colours[facing], wrong[facing], rtol=1e-2)


def test_a_matrix_is_a_rotation_too(asset: Asset, light: LightFit) -> None:
    angles = (10.0, 70.0, -30.0)
    np.testing.assert_array_equal(
        asset.vertex_radiance((0, 0, 9), light, rotation=angles),
        asset.vertex_radiance((0, 0, 9), light, rotation=rotation_matrix(angles)),
    )
    with pytest.raises(ValueError, match="rotation has shape"):
        asset.relight(light, rotation=np.eye(4))


def test_files_give_the_same(asset: Asset, light: LightFit, tmp_path: Path) -> None:
    write_asset(tmp_path / "asset.h5", asset.data, bits=32)
    write_light(tmp_path / "light.h5", light)
    opened = Asset.open(tmp_path / "asset.h5")
    from_files = opened.vertex_radiance((3, 4, 5), tmp_path / "light.h5")
    direct = asset.vertex_radiance((3, 4, 5), light)
    np.testing.assert_allclose(from_files, direct, rtol=1e-5, atol=1e-5)
    with pytest.raises(CorruptArtefact):
        Asset.open(tmp_path / "light.h5")


def test_an_asset_says_its_bits_and_error(asset: Asset, tmp_path: Path) -> None:
    assert asset.precision == {"object": None}
    write_asset(tmp_path / "asset.h5", asset.data, bits=8, errors=[1e-3])
    stated = Asset.open(tmp_path / "asset.h5").precision["object"]
    assert stated is not None
    assert stated.error == 1e-3
    assert stated.bits["weights"] == 8


def test_what_a_light_costs_is_paid_once(asset: Asset, light: LightFit) -> None:
    lit = asset.relight(light)
    np.testing.assert_array_equal(
        asset.vertex_radiance((0, 9, 0), lit), asset.vertex_radiance((0, 9, 0), light)
    )


def test_corners_of_triangles_have_the_colours_of_vertices(asset: Asset, light: LightFit) -> None:
    eye = np.array([5.0, 6.0, 7.0])
    lit = asset.relight(light)
    wo = (eye - POSITIONS[0]) / np.linalg.norm(eye - POSITIONS[0])
    corner = asset.shade(np.array([0], np.int32), np.array([[1.0, 0, 0]]), wo[None], lit)
    np.testing.assert_allclose(corner[0], asset.vertex_radiance(eye, lit)[0], rtol=1e-5)


def test_an_albedo_texture_colours_its_vertices(asset: Asset, light: LightFit) -> None:
    plain = asset.vertex_radiance((3, 4, 5), light)
    texture = np.zeros((2, 2, 3), np.float32)
    texture[..., 0] = 1.0  # red lets red through and nothing else
    part = replace(asset.data.parts[0], albedo_texture=texture)
    uv = np.full((VERTS, 2), 0.3, np.float32)
    red = Asset(replace(asset.data, uv=uv, parts=(part,)))
    colours = red.vertex_radiance((3, 4, 5), light)
    np.testing.assert_allclose(colours[:, 0], plain[:, 0], rtol=1e-6)
    assert (colours[:, 1:] == 0).all()
    # vertex colours multiply what the texture left, each vertex by its own
    tints = np.linspace(0.1, 0.9, VERTS * 3).reshape(VERTS, 3).astype(np.float32)
    both = Asset(replace(red.data, parts=(replace(part, vertex_colours=tints),)))
    found = both.vertex_radiance((3, 4, 5), light)
    np.testing.assert_allclose(found, colours * tints, rtol=1e-6)
    assert not np.allclose(found, colours * tints[::-1], rtol=1e-2)
