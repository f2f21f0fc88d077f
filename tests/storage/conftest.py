"""Small assets and transfers that the storage tests share."""

from typing import Any

import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs


def unit(rng: np.random.Generator, n: int) -> np.ndarray:
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def frames_about(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    tangent = np.cross(normals, unit(rng, len(normals)))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([tangent, np.cross(normals, tangent), normals], axis=1)


def make_asset(
    rng: np.random.Generator, n_glossy: int = 60, n_diffuse: int = 30, n_channels: int = 1
) -> Asset:
    """A triangle soup in two parts with random factors: CTA with a view texture, and CPCA."""
    verts, coeffs, clusters = n_glossy + n_diffuse, 42, 4
    r_view, r_light, r_vert, terms, pcs = 3, 5, 4, 6, 2
    normals = unit(rng, verts).astype(np.float32)
    triangles = [rng.permutation(n_glossy).reshape(-1, 3)]
    triangles.append(n_glossy + rng.permutation(n_diffuse).reshape(-1, 3))
    falling = (10.0 ** -np.arange(r_vert)).astype(np.float32)

    def random(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    def ranks(*of_all: int) -> np.ndarray:
        return np.tile(np.array(of_all, np.int32), (clusters, 1))

    common: dict[str, Any] = {"n_channels": n_channels}
    glossy = Part(
        name="object", vertex_range=(0, n_glossy), material={"model": "phong", "exponent": 10.0},
        method="cta", labels=rng.integers(0, clusters, n_glossy).astype(np.int32),
        ranks=ranks(2, 2, 2), weights=random(n_glossy, r_vert) * falling, view_basis=random(terms, r_view),
        view_texture=random(8, 8, r_view, 3), light_bases=random(clusters, coeffs, r_light),
        dual_bases=random(clusters, r_vert, n_channels * r_view * r_light),
        frames=frames_about(normals[:n_glossy].astype(np.float64), rng).astype(np.float32),
        albedo=np.ones(3, np.float32), factorisation={"psi_radial": rng.normal(size=(5, 2)), "n_theta": 28, "note": ""},
        **common,
    )  # fmt: skip
    diffuse = Part(
        name="receiver", vertex_range=(n_glossy, verts), material={"model": "lambert"},
        method="cpca", labels=rng.integers(0, clusters, n_diffuse).astype(np.int32),
        ranks=ranks(1, coeffs, 2), weights=random(n_diffuse, pcs), means=random(clusters, n_channels * coeffs),
        components=random(clusters, pcs, n_channels * coeffs), albedo=np.array([0.7], np.float32),
        albedo_texture=rng.random((4, 6, 3)).astype(np.float32), **common,
    )  # fmt: skip
    return Asset(
        positions=random(verts, 3), faces=np.concatenate(triangles).astype(np.int32),
        normals=normals, uv=rng.random((verts, 2)).astype(np.float32), parts=(glossy, diffuse),
        basis=WhitenedSrbfs(unit(rng, coeffs), 10.0), provenance={"seed": 3, "inputs": ["é"]},
    )  # fmt: skip


@pytest.fixture
def asset(rng: np.random.Generator) -> Asset:
    return make_asset(rng)


@pytest.fixture
def coloured(rng: np.random.Generator) -> Asset:
    """The same with three channels of transfer."""
    return make_asset(rng, n_channels=3)
