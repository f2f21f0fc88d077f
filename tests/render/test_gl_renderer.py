"""OpenGL against the numpy decode on the same view."""

import gc
from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.contract.settings import Camera
from prtbake_storage.decode.asset import Asset, Part, check_asset
from prtbake_storage.decode.relight import rotation_matrix
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.render.camera import Pinhole, pinhole
from prtbake_workers.render.context import GlUnavailable, check_error, create_context
from prtbake_workers.render.cpu_renderer import CpuRenderer
from prtbake_workers.render.gl_renderer import GlRenderer
from prtbake_workers.render.picture import Renderer
from support.means import with_means

pytestmark = pytest.mark.gl

WIDTH, HEIGHT = 120, 90

INTERIOR = 1e-3
"""Of the brightest value, where both see the same triangle.  The limit is the barycentrics: float32
rays and rasteriser differ by 1e-4 to 1e-3 on triangles seen edge-on; worst of 16 views 3.0e-4."""

SILHOUETTE_SHARE = 0.002
"""Pixels where the centre falls on an edge within float32: worst of 16 views 7 in 10,800."""


def view_of(asset: Asset, azimuth: float = 30.0) -> Pinhole:
    bounds = np.stack([asset.positions.min(axis=0), asset.positions.max(axis=0)])
    return pinhole(Camera(azimuth_deg=azimuth), WIDTH, HEIGHT, bounds.astype(np.float64))


def mismatch(a: Renderer, b: Renderer, view: Pinhole) -> tuple[float, float]:
    """Largest relative difference where both see one triangle; share of other pixels."""
    same = (
        a.visibility(view, WIDTH, HEIGHT).triangles == b.visibility(view, WIDTH, HEIGHT).triangles
    )
    one, two = a.render(view, WIDTH, HEIGHT), b.render(view, WIDTH, HEIGHT)
    assert 0.1 < one.coverage.mean() < 0.9
    difference = np.abs(one.radiance - two.radiance).max(axis=2)
    return float(difference[same].max() / np.abs(two.radiance).max()), float((~same).mean())


def assert_agree(gl: GlRenderer, cpu: CpuRenderer, light: np.ndarray, view: Pinhole) -> None:
    """Light both and hold their pictures against each other, inside and at silhouettes."""
    gl.set_light(light)
    cpu.set_light(light)
    interior, share = mismatch(gl, cpu, view)
    assert interior < INTERIOR
    assert share < SILHOUETTE_SHARE


@pytest.mark.parametrize("azimuth", [30.0, 160.0])
def test_gl_agrees_with_the_numpy_decode(scene: Asset, light: np.ndarray, azimuth: float) -> None:
    view = view_of(scene, azimuth)
    with GlRenderer(scene) as gl, CpuRenderer(scene) as cpu:
        assert gl.info.backend == "egl"
        assert gl.info.device
        for current in (light, rotation_matrix((10, 20, 30)) @ light.T):
            values = current if current.shape == light.shape else current.T
            assert_agree(gl, cpu, values, view)
    # negative twin: all frames aligned instead of turned at random
    part = scene.parts[0]
    aligned = tangent_frames(scene.normals[: part.n_vertices].astype(np.float64))
    other = replace(scene, parts=(replace(part, frames=aligned.astype(np.float32)), scene.parts[1]))
    with GlRenderer(other) as gl, CpuRenderer(scene) as cpu:
        gl.set_light(light)
        cpu.set_light(light)
        assert mismatch(gl, cpu, view)[0] > 10 * INTERIOR


@pytest.mark.parametrize("elevation", [25.0, -25.0])
def test_gl_shows_the_side_that_faces_the_eye(
    two_sided_scene: Asset, light: np.ndarray, elevation: float
) -> None:
    """Both copies lie in one place: without culling the depth test would let rounding choose."""
    own = two_sided_scene
    bounds = np.stack([own.positions.min(axis=0), own.positions.max(axis=0)]).astype(np.float64)
    view = pinhole(Camera(elevation_deg=elevation), WIDTH, HEIGHT, bounds)
    half = own.parts[0].vertex_range[1] + own.parts[1].n_vertices // 2
    with GlRenderer(own) as gl, CpuRenderer(own) as cpu:
        assert_agree(gl, cpu, light, view)
        triangles = gl.visibility(view, WIDTH, HEIGHT).triangles
        first = own.faces[triangles[triangles >= 0], 0]
        plane = first[first >= own.parts[1].vertex_range[0]]
        assert len(plane) > 1000
        assert ((plane >= half) == (elevation < 0.0)).all()
    # negative twin: an asset that does not say so; from below, one of its sides is black
    blind = replace(own, parts=(own.parts[0], replace(own.parts[1], two_sided=False)))
    with GlRenderer(blind) as gl, CpuRenderer(own) as cpu:
        gl.set_light(light)
        cpu.set_light(light)
        shown = gl.visibility(view, WIDTH, HEIGHT).triangles
        first = own.faces[shown[shown >= 0], 0]
        assert (first[first >= own.parts[1].vertex_range[0]] < half).any()


def test_gl_agrees_with_the_numpy_decode_in_three_channels(
    coloured_scene: Asset, light: np.ndarray
) -> None:
    view = view_of(coloured_scene)
    with GlRenderer(coloured_scene) as gl, CpuRenderer(coloured_scene) as cpu:
        assert_agree(gl, cpu, light, view)
    # negative twin: green and blue of the transfer change places
    glossy, diffuse = coloured_scene.parts
    assert glossy.dual_bases is not None
    rows = glossy.dual_bases.reshape(2, 5, 3, -1)[:, :, [0, 2, 1]]
    swapped = replace(glossy, dual_bases=rows.reshape(glossy.dual_bases.shape))
    with (
        GlRenderer(replace(coloured_scene, parts=(swapped, diffuse))) as gl,
        CpuRenderer(coloured_scene) as cpu,
    ):
        gl.set_light(light)
        cpu.set_light(light)
        assert mismatch(gl, cpu, view)[0] > 10 * INTERIOR


@pytest.mark.parametrize("method", ["vq", "pca", "cpca"])
def test_gl_agrees_with_the_numpy_decode_on_means_of_several_terms(
    coloured_scene: Asset, light: np.ndarray, rng: np.random.Generator, method: str
) -> None:
    glossy, diffuse = coloured_scene.parts
    part = with_means(glossy, method, coloured_scene.n_coeffs, rng)
    own = replace(coloured_scene, parts=(part, diffuse))
    check_asset(own)
    view = view_of(own)
    with GlRenderer(own) as gl, CpuRenderer(own) as cpu:
        assert_agree(gl, cpu, light, view)
    # negative twin: the first two terms change places
    assert part.means is not None
    rows = part.means.reshape(part.n_clusters, 3, 3, -1)[:, :, [1, 0, 2]]
    swapped = replace(own, parts=(replace(part, means=rows.reshape(part.means.shape)), diffuse))
    with GlRenderer(swapped) as gl, CpuRenderer(own) as cpu:
        gl.set_light(light)
        cpu.set_light(light)
        assert mismatch(gl, cpu, view)[0] > 10 * INTERIOR


def with_a_chip(scene: Asset) -> Asset:
    """A third part: one triangle in front of the others, with three clusters for its vertices."""
    n = scene.n_vertices
    chip = Part(
        name="chip", vertex_range=(n, n + 3), material={"model": "lambert"}, method="cpca",
        labels=np.arange(3, dtype=np.int32), weights=np.zeros((3, 1), np.float32),
        means=np.arange(36, dtype=np.float32).reshape(3, 12), ranks=np.ones((3, 3), np.int32),
        components=np.zeros((3, 1, 12), np.float32), albedo=np.array([0.2, 0.9, 0.4], np.float32),
    )  # fmt: skip
    corners = np.array([[0.0, 0.6, 1.5], [1.6, 0.6, 1.5], [0.8, 1.8, 1.5]], np.float32)
    return replace(
        scene,
        positions=np.concatenate([scene.positions, corners]),
        faces=np.concatenate([scene.faces, np.array([[n, n + 1, n + 2]], np.int32)]),
        normals=np.concatenate([scene.normals, np.tile(np.float32([0, 0, 1]), (3, 1))]),
        uv=np.concatenate([scene.uv, np.zeros((3, 2), np.float32)]),
        parts=(*scene.parts, chip),
    )


def test_a_part_of_one_triangle_is_drawn_beside_large_ones(scene: Asset, light: np.ndarray) -> None:
    three = with_a_chip(scene)
    check_asset(three)
    view = view_of(three)
    with GlRenderer(three) as gl, CpuRenderer(three) as cpu:
        assert_agree(gl, cpu, light, view)
        seen = gl.visibility(view, WIDTH, HEIGHT).triangles == len(three.faces) - 1
        assert np.count_nonzero(seen) > 100
        # negative twin: its albedo is its own, not that of the part drawn before it
        shown = gl.render(view, WIDTH, HEIGHT).radiance[seen]
    grey = replace(three.parts[2], albedo=np.ones(3, np.float32))
    with GlRenderer(replace(three, parts=(*scene.parts, grey))) as gl:
        gl.set_light(light)
        plain = gl.render(view, WIDTH, HEIGHT).radiance[seen]
    np.testing.assert_allclose(shown, plain * three.parts[2].albedo, rtol=1e-4, atol=1e-6)
    assert np.abs(shown - plain).max() > 0.1 * np.abs(plain).max()


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_the_size_of_the_scene_does_not_matter(
    scene: Asset, light: np.ndarray, scale: float
) -> None:
    scaled = replace(scene, positions=scene.positions * np.float32(scale))
    with GlRenderer(scaled) as gl, CpuRenderer(scaled) as cpu:
        assert_agree(gl, cpu, light, view_of(scaled))


def test_coloured_albedo_and_one_channel_textures(scene: Asset, light: np.ndarray) -> None:
    glossy, diffuse = scene.parts
    assert glossy.view_texture is not None
    grey = replace(glossy, view_texture=glossy.view_texture[..., :1].copy())
    red = replace(diffuse, albedo=np.array([0.9, 0.2, 0.1], np.float32), albedo_texture=None)
    asset = replace(scene, parts=(grey, red))
    with GlRenderer(asset) as gl, CpuRenderer(asset) as cpu:
        gl.set_light(light)
        cpu.set_light(light)
        assert mismatch(gl, cpu, view_of(asset))[0] < INTERIOR


def test_vertex_colours_are_interpolated_at_the_pixel(
    scene: Asset, light: np.ndarray, rng: np.random.Generator
) -> None:
    """On a part that does not begin at vertex 0, beside a texture; the other part has none."""
    glossy, diffuse = scene.parts
    colours = rng.random((diffuse.n_vertices, 3)).astype(np.float32)
    asset = replace(scene, parts=(glossy, replace(diffuse, vertex_colours=colours)))
    with GlRenderer(asset) as gl, CpuRenderer(asset) as cpu, CpuRenderer(scene) as plain:
        for renderer in (gl, cpu, plain):
            renderer.set_light(light)
        assert mismatch(gl, cpu, view_of(asset))[0] < INTERIOR
        # the negative twin: without them the picture is another
        assert mismatch(gl, plain, view_of(asset))[0] > 20 * INTERIOR


def test_triangles_are_black_from_behind(scene: Asset, light: np.ndarray) -> None:
    below = pinhole(
        Camera(eye=(0.0, -4.0, 0.5), target=(0, 0, 0)),
        WIDTH,
        HEIGHT,
        np.array([[-1.0] * 3, [1] * 3]),
    )
    for renderer in (GlRenderer(scene), CpuRenderer(scene)):
        with renderer:
            renderer.set_light(light)
            picture = renderer.render(below, WIDTH, HEIGHT)
        assert picture.coverage.mean() > 0.3
        assert (picture.radiance == 0).all()


def test_two_renderers_take_turns_and_sizes_change(scene: Asset, light: np.ndarray) -> None:
    view = view_of(scene)
    first, second = GlRenderer(scene), GlRenderer(scene)
    first.set_light(light)
    second.set_light(2 * light)
    before = first.render(view, WIDTH, HEIGHT)
    double = second.render(view, WIDTH, HEIGHT)
    np.testing.assert_allclose(double.radiance, 2 * before.radiance, rtol=1e-5, atol=1e-6)
    small = first.render(view, WIDTH // 2, HEIGHT // 2)
    assert small.radiance.shape == (HEIGHT // 2, WIDTH // 2, 3)
    np.testing.assert_array_equal(first.render(view, WIDTH, HEIGHT).radiance, before.radiance)
    first.release()
    first.release()
    np.testing.assert_array_equal(second.render(view, WIDTH, HEIGHT).radiance, double.radiance)
    second.release()


def test_a_dead_renderer_takes_nothing_of_a_living_one(scene: Asset, light: np.ndarray) -> None:
    """Names of OpenGL objects are per context: whoever deletes in the wrong one deletes another's."""
    view = view_of(scene)
    with GlRenderer(scene) as living:
        living.set_light(light)
        before = living.render(view, WIDTH, HEIGHT)
        dead = GlRenderer(scene)
        dead.set_light(light)
        dead.render(view, WIDTH, HEIGHT)
        dead.release()
        with living._context:
            del dead
            gc.collect()
        after = living.render(view, WIDTH, HEIGHT)
    np.testing.assert_array_equal(after.radiance, before.radiance)


def test_samples_average_the_finer_picture(scene: Asset, light: np.ndarray) -> None:
    view = view_of(scene)
    with GlRenderer(scene) as gl:
        gl.set_light(light)
        fine = gl.render(view, 2 * WIDTH, 2 * HEIGHT)
        found = gl.render(view, WIDTH, HEIGHT, samples=2)
    expected = fine.radiance.reshape(HEIGHT, 2, WIDTH, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(found.radiance, expected, rtol=1e-5, atol=1e-6)
    assert set(np.unique(found.coverage)) == {0.0, 0.25, 0.5, 0.75, 1.0}


def test_render_needs_a_light(scene: Asset) -> None:
    with GlRenderer(scene) as gl, pytest.raises(ValueError, match="set_light"):
        gl.render(view_of(scene), 8, 8)


def test_a_recorded_error_is_not_passed_over() -> None:
    context = create_context()
    try:
        check_error(context, "nothing")
        texture = context.texture((4, 4), 4, dtype="f4")
        framebuffer = context.framebuffer([texture])
        framebuffer.use()
        framebuffer.release()
        # the framebuffer that is bound is gone: OpenGL objects, the library says nothing
        context.framebuffer([texture])
        with pytest.raises(GlUnavailable, match="GL_INVALID_OPERATION while testing"):
            check_error(context, "testing")
    finally:
        context.release()
