"""A small scene to draw; and where there is no OpenGL, its tests are deselected, aloud.

``PRTBAKE_REQUIRE_GL=1`` (set in CI) keeps them, so that they fail instead.
"""

import os

import numpy as np
import pytest

from prtbake_storage.decode.asset import Asset, Part
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.decode.view_map import hemi_octahedral_inverse, texel_centres
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.sides import both_sides
from prtbake_workers.render.context import GlUnavailable, probe


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    drawing = [item for item in items if item.get_closest_marker("gl")]
    if not drawing or os.environ.get("PRTBAKE_REQUIRE_GL"):
        return
    try:
        probe()
    except GlUnavailable as error:
        config.hook.pytest_deselected(items=drawing)
        items[:] = [item for item in items if item not in drawing]
        reporter = config.pluginmanager.get_plugin("terminalreporter")
        if reporter is not None:
            reporter.write_line(f"{len(drawing)} tests of OpenGL deselected: {error.detail}")


def frames_about(normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    tangent = np.cross(normals, rng.normal(size=normals.shape))
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    return np.stack([tangent, np.cross(normals, tangent), normals], axis=1)


def make_scene(
    rng: np.random.Generator, scale: float = 1.0, n_channels: int = 1, *, two_sided: bool = False
) -> Asset:
    """A glossy sphere (CTA, a frame turned at random for each vertex) over a textured plane.

    The plane may have two sides.
    """
    sphere, plane = sphere_mesh(3), grid_mesh(6, 6)
    plane = both_sides(plane) if two_sided else plane
    n, m = len(sphere.positions), len(plane.positions)
    coeffs, r_view, r_light, r_vert = 12, 3, 4, 5
    map_directions = hemi_octahedral_inverse(texel_centres(32))
    x, y, z = np.moveaxis(map_directions, -1, 0)
    phi = np.stack([0.2 + z, x, x * x - y * y], axis=-1)[..., None] * [1.0, 0.9, 0.7]

    def random(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    glossy = Part(
        name="object", vertex_range=(0, n), material={"model": "phong"}, method="cta",
        labels=(sphere.positions[:, 0] > 0).astype(np.int32),
        weights=np.cos(sphere.positions @ rng.normal(size=(3, r_vert))).astype(np.float32),
        view_basis=np.eye(r_view, dtype=np.float32), view_texture=phi.astype(np.float32),
        light_bases=random(2, coeffs, r_light), dual_bases=random(2, r_vert, n_channels * r_view * r_light),
        frames=frames_about(sphere.normals, rng).astype(np.float32),
        albedo=np.ones(3, np.float32), ranks=np.full((2, 3), 3, np.int32),
        n_channels=n_channels,
    )  # fmt: skip
    diffuse = Part(
        name="receiver", vertex_range=(n, n + m), material={"model": "lambert"}, method="cpca",
        labels=np.zeros(m, np.int32), weights=random(m, 1), means=random(1, n_channels * coeffs),
        components=0.1 * random(1, 1, n_channels * coeffs), albedo=np.array([0.7], np.float32),
        albedo_texture=rng.random((5, 7, 3)).astype(np.float32), ranks=np.ones((1, 3), np.int32),
        n_channels=n_channels, two_sided=two_sided,
    )  # fmt: skip
    positions = np.concatenate([sphere.positions, plane.positions * 5.0]) * scale
    uv = np.concatenate([np.zeros((n, 2)), rng.uniform(-1, 2, (m, 2))])
    return Asset(
        positions=positions.astype(np.float32),
        faces=np.concatenate([sphere.faces, plane.faces + n]).astype(np.int32),
        normals=np.concatenate([sphere.normals, plane.normals]).astype(np.float32),
        uv=uv.astype(np.float32), parts=(glossy, diffuse),
        basis=WhitenedSrbfs(icosphere(0), 3.0),
    )  # fmt: skip


@pytest.fixture
def scene(rng: np.random.Generator) -> Asset:
    return make_scene(rng)


@pytest.fixture
def coloured_scene(rng: np.random.Generator) -> Asset:
    """The same with three channels of transfer."""
    return make_scene(rng, n_channels=3)


@pytest.fixture
def two_sided_scene(rng: np.random.Generator) -> Asset:
    """The same over a plane that can be seen from below."""
    return make_scene(rng, two_sided=True)


@pytest.fixture
def light(rng: np.random.Generator) -> np.ndarray:
    return rng.normal(size=(12, 3))
