"""The bake against its plain twin, closed forms and itself."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.primitives import grid_mesh, sphere_mesh
from prtbake_workers.geometry.raw_mesh import RawMesh
from prtbake_workers.geometry.repair import repair
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport import bake as bake_module
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.mirrored import MirroredProduct, product_of
from prtbake_workers.transport.plain_product import PlainProduct
from support.dense_twin import bake_dense, sampled_transport

CUBE = cube_directions(12)


@pytest.fixture(scope="module")
def basis():
    return SrbfBasis(icosphere(2))


@pytest.fixture(scope="module")
def projection(basis):
    return basis.projection(CUBE.directions, CUBE.weights)


@pytest.fixture(scope="module")
def glossy():
    brdf = CookTorrance(np.array([0.3]), np.array([0.7]), 0.5, np.array([0.1]))
    return factorise(brdf, n_terms=7, n_theta=12, n_phi=32)


@pytest.fixture(scope="module")
def diffuse():
    return factorise(Lambert(np.array([0.5])))


def moved(mesh, offset, scale=1.0):
    return Mesh(scale * (mesh.positions + np.asarray(offset)), mesh.faces, mesh.normals)


def balls_on_plane(scale=1.0, frame_seed=None):
    """A plane and two balls, one larger, floating close to each other."""
    parts = [
        moved(grid_mesh(8, 8), [0.0, -0.05, 0.0], 4.0 * scale),
        moved(sphere_mesh(2, radius=0.5), [0.0, 0.0, 0.0], scale),
        moved(sphere_mesh(1, radius=0.3), [0.75, 0.1, 0.2], scale),
    ]
    return Scene.from_parts(parts, frame_seed=frame_seed)


@pytest.fixture(scope="module")
def scene():
    return balls_on_plane()


@pytest.fixture(scope="module")
def accelerator(scene):
    return Accelerator(scene.positions, scene.faces)


@pytest.fixture(scope="module")
def baked(scene, accelerator, glossy, projection):
    return bake_block(
        scene, accelerator, (0, scene.n_vertices),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip


@pytest.mark.parametrize("kind", [MirroredProduct, PlainProduct])
@pytest.mark.parametrize("supersample", [1, 2])
@pytest.mark.parametrize("vertex_range", [(30, 45), (100, 130)])
def test_bake_equals_its_plain_twin(
    scene, accelerator, glossy, projection, kind, supersample, vertex_range
):
    settings = {"factorisation": glossy, "projection": projection, "directions": CUBE}
    found = product_of(projection, CUBE.directions)
    assert isinstance(found, MirroredProduct)
    product = found if kind is MirroredProduct else PlainProduct.of(projection)
    fast = bake_block(
        scene, accelerator, vertex_range, supersample=supersample, product=product, **settings
    )
    slow, signal, residual = bake_dense(
        scene, accelerator, vertex_range, supersample=supersample, **settings
    )
    # float32 samples: 1e-6 of the largest measured; a ray that just grazes moves whole samples,
    # none does here
    atol = 2e-5 * np.abs(slow).max()
    np.testing.assert_allclose(fast.coefficients, slow, rtol=0, atol=atol)
    np.testing.assert_allclose(fast.signal_energy, signal, rtol=2e-5)
    np.testing.assert_allclose(fast.residual_energy, residual, rtol=0, atol=2e-6 * signal.max())
    # negative twins: no shadows; another supersampling
    bright = bake_dense(scene, None, vertex_range, **settings)[0]
    assert np.abs(bright - slow).max() > 100 * atol
    other = bake_dense(scene, accelerator, vertex_range, supersample=3, **settings)[0]
    assert np.abs(other - slow).max() > 100 * atol


def test_energies_in_float64_are_those_of_the_samples(scene, accelerator, glossy, baked):
    samples = sampled_transport(
        scene, accelerator, 40, factorisation=glossy, directions=CUBE
    )  # fmt: skip
    energy = float((samples**2 @ CUBE.weights).sum())
    assert baked.signal_energy[40] == pytest.approx(energy, rel=1e-5)
    assert (baked.residual_energy > 0).any()
    assert (baked.residual_energy <= baked.signal_energy).all()


def test_same_bytes_whatever_the_threads(scene, accelerator, glossy, projection, baked):
    again = bake_block(
        scene, accelerator, (0, scene.n_vertices),
        factorisation=glossy, projection=projection, directions=CUBE, threads=3,
    )  # fmt: skip
    assert again.coefficients.tobytes() == baked.coefficients.tobytes()
    assert again.residual_energy.tobytes() == baked.residual_energy.tobytes()
    assert again.counters() == baked.counters()


def test_chunks_of_one_vertex_change_nothing(
    scene, accelerator, glossy, projection, baked, monkeypatch
):
    monkeypatch.setattr(bake_module, "CHUNK_BYTES", 1)
    single = bake_block(
        scene, accelerator, (70, 110),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip
    # other groups sum in another order: float32 rounding only, measured 1.1e-6
    atol = 5e-6 * np.abs(baked.coefficients).max()
    np.testing.assert_allclose(single.coefficients, baked.coefficients[70:110], rtol=0, atol=atol)


def test_tiles_agree_with_the_whole(scene, accelerator, glossy, projection, baked):
    for start, stop in [(0, 50), (50, 51), (51, scene.n_vertices)]:
        tile = bake_block(
            scene, accelerator, (start, stop),
            factorisation=glossy, projection=projection, directions=CUBE,
        )  # fmt: skip
        # as above
        atol = 5e-6 * np.abs(baked.coefficients).max()
        whole = baked.coefficients[start:stop]
        np.testing.assert_allclose(tile.coefficients, whole, rtol=0, atol=atol)


def test_residual_from_differences_agrees(
    scene, accelerator, glossy, projection, baked, monkeypatch
):
    monkeypatch.setattr(bake_module, "CANCELLATION_LIMIT", 1.0)
    direct = bake_block(
        scene, accelerator, (95, 120),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip
    assert direct.n_direct_residuals == 25
    assert baked.n_direct_residuals == 0
    np.testing.assert_allclose(
        direct.residual_energy,
        baked.residual_energy[95:120],
        rtol=0,
        atol=2e-6 * baked.signal_energy.max(),
    )


def test_turning_the_frames_keeps_the_energies(baked, accelerator, glossy, projection):
    """No degenerate pair is split: terms mix among themselves, their energy stays."""
    turned_scene = balls_on_plane(frame_seed=5)
    turned = bake_block(
        turned_scene, accelerator, (0, turned_scene.n_vertices),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip
    np.testing.assert_allclose(turned.signal_energy, baked.signal_energy, rtol=1e-5)
    by_term = (turned.coefficients**2).sum(axis=2) - (baked.coefficients**2).sum(axis=2)
    assert np.abs(by_term).max() > 1e-3 * baked.signal_energy.max()


def irradiance(block, basis):
    """Reflected radiance under constant light of radiance 1; white and unoccluded it is 1."""
    fine = cube_directions(24)
    light = basis.light_from_radiance(fine.directions, fine.weights, np.ones((fine.n, 3)))
    return block.coefficients[:, 0] @ light[:, 0]


def test_convex_object_alone_sees_everything(basis, diffuse, projection):
    ball = Scene.from_parts([sphere_mesh(3)])
    accelerator = Accelerator(ball.positions, ball.faces)
    settings = {"factorisation": diffuse, "projection": projection, "directions": CUBE}
    lit = bake_block(ball, accelerator, (0, ball.n_vertices), **settings)
    free = bake_block(ball, None, (0, ball.n_vertices), **settings)
    np.testing.assert_array_equal(lit.coefficients, free.coefficients)
    assert lit.n_rays + lit.n_culled == ball.n_vertices * CUBE.n
    assert free.n_rays == 0
    assert bake_block(ball, accelerator, (0, 5), shadows=False, **settings).n_rays == 0
    # 1 %: quadrature of the cosine's kink over 12 x 12 texels a face
    np.testing.assert_allclose(irradiance(lit, basis), 1.0, rtol=0.01)


def test_ball_over_a_point_hides_its_form_factor(basis, diffuse, projection):
    """A sphere of radius r at distance d, wholly above the horizon, covers (r / d)^2 cos theta."""
    centre, radius = np.array([0.5, 1.0, 0.3]), 0.6
    ball = moved(sphere_mesh(4, radius=radius), centre - [0.0, radius, 0.0])
    plane = grid_mesh(2, 2)  # vertex 4 is the origin
    scene = Scene.from_parts([plane, ball])
    accelerator = Accelerator(scene.positions, scene.faces)
    distance = np.linalg.norm(centre)
    expected = 1.0 - (radius / distance) ** 2 * (centre[1] / distance)
    got = {}
    for supersample in (1, 4):
        block = bake_block(
            scene, accelerator, (4, 5), supersample=supersample,
            factorisation=diffuse, projection=projection, directions=CUBE,
        )  # fmt: skip
        got[supersample] = float(irradiance(block, basis)[0])
    assert got[4] == pytest.approx(expected, abs=0.005)  # the polyhedron and the texels: 0.002
    assert got[1] == pytest.approx(expected, abs=0.03)
    assert got[4] != pytest.approx(1.0, abs=0.05)
    assert got[4] != pytest.approx(1.0 - (radius / distance) ** 2, abs=0.02)  # without cosine


def test_wall_hides_half_the_sky(basis, diffuse, projection):
    """A vertex at the foot of a wall that reaches far loses exactly the half behind it."""
    x = 0.01
    wall = Mesh(
        np.array([[x, -900.0, -900.0], [x, 900.0, -900.0], [x, 900.0, 900.0], [x, -900.0, 900.0]]),
        np.array([[0, 2, 1], [0, 3, 2]], np.int32),
        np.tile([-1.0, 0.0, 0.0], (4, 1)),
    )
    floor = grid_mesh(2, 2)
    scene = Scene.from_parts([floor, wall])
    accelerator = Accelerator(scene.positions, scene.faces)
    block = bake_block(
        scene, accelerator, (4, 5), factorisation=diffuse, projection=projection, directions=CUBE
    )
    assert irradiance(block, basis)[0] == pytest.approx(0.5, abs=0.005)
    free = bake_block(
        scene, None, (4, 5), factorisation=diffuse, projection=projection, directions=CUBE
    )
    assert block.signal_energy[0] == pytest.approx(0.5 * free.signal_energy[0], rel=1e-6)
    np.testing.assert_allclose(free.coefficients[0, 0] @ free.coefficients[0, 0],
                               free.signal_energy[0], rtol=0.01)  # fmt: skip


@pytest.mark.parametrize("scale", [1e-4, 1e4])
def test_scenes_of_any_size_give_the_same_transport(baked, glossy, projection, scale):
    scene = balls_on_plane(scale)
    accelerator = Accelerator(scene.positions, scene.faces)
    block = bake_block(
        scene, accelerator, (0, scene.n_vertices),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip
    difference = (block.coefficients - baked.coefficients).astype(np.float64)
    # a handful of rays that graze an edge may fall on its other side
    share = (difference**2).sum() / baked.signal_energy.sum()
    assert share < 1e-4
    assert block.epsilon == pytest.approx(baked.epsilon * scale, rel=0.5)


def test_inside_of_another_object_is_black(glossy, projection):
    inner = moved(sphere_mesh(1, radius=0.2), [0.0, 0.8, 0.0])
    scene = Scene.from_parts([inner, sphere_mesh(3)])
    accelerator = Accelerator(scene.positions, scene.faces)
    block = bake_block(
        scene, accelerator, (0, inner.n_vertices),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip
    assert not block.coefficients.any()
    assert not block.signal_energy.any()
    assert not block.residual_energy.any()
    alone = bake_block(
        Scene.from_parts([inner]), None, (0, inner.n_vertices),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip
    assert (alone.signal_energy > 0).all()


@pytest.mark.parametrize(("robust", "leak"), [(True, 0.0), (False, 2e-3)])
def test_closed_mesh_seen_from_inside_is_black(diffuse, projection, robust, leak):
    """Embree's fast test lets a few of the rays through that are aimed exactly at an edge."""
    ball = sphere_mesh(2)
    inside = Mesh(ball.positions, ball.faces[:, ::-1].copy(), -ball.normals)
    scene = Scene.from_parts([inside])
    accelerator = Accelerator(scene.positions, scene.faces, robust=robust)
    settings = {"factorisation": diffuse, "projection": projection, "directions": CUBE}
    block = bake_block(scene, accelerator, (0, ball.n_vertices), **settings)
    open_sky = bake_block(scene, None, (0, ball.n_vertices), **settings)
    assert block.signal_energy.sum() <= leak * open_sky.signal_energy.sum()
    assert block.n_rays > 0


def room(*, open_top=False):
    """A box seen from within, its vertices split along its edges; turned off the axes."""
    corners = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
         [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3], [2, 3, 7], [2, 7, 6]]
    )[:, ::-1]  # fmt: skip
    turn, _ = np.linalg.qr(np.array([[1.0, 0.3, 0.2], [-0.3, 1.0, 0.4], [0.1, -0.4, 1.0]]))
    positions = corners @ (turn * np.sign(np.linalg.det(turn)))
    raw = RawMesh(positions, np.ascontiguousarray(faces[: 10 if open_top else 12]))
    return repair(raw, "test", orient_outward=False, crease_angle_deg=30.0)[0]


def test_a_closed_room_of_flat_walls_is_black(diffuse, projection):
    """Its vertices are split: rays along their own normals would start in the next wall's plane."""
    scene = Scene.from_parts([room()])
    assert scene.n_vertices == 24
    accelerator = Accelerator(scene.positions, scene.faces, robust=True)
    settings = {"factorisation": diffuse, "projection": projection, "directions": CUBE}
    assert not bake_block(scene, accelerator, (0, 24), **settings).signal_energy.any()
    # the negative twin: by the normals, light passes the walls
    leaking = replace(scene)
    leaking.__dict__["ray_sides"] = scene.normals
    open_sky = bake_block(scene, None, (0, 24), **settings).signal_energy.sum()
    leak = bake_block(leaking, accelerator, (0, 24), **settings).signal_energy.sum()
    assert leak > 0.05 * open_sky


def test_split_vertices_bake_as_in_the_plain_twin(glossy, projection):
    scene = Scene.from_parts([room(open_top=True)])
    accelerator = Accelerator(scene.positions, scene.faces, robust=True)
    settings = {"factorisation": glossy, "projection": projection, "directions": CUBE}
    fast = bake_block(scene, accelerator, (0, scene.n_vertices), **settings)
    slow, signal, _ = bake_dense(scene, accelerator, (0, scene.n_vertices), **settings)
    atol = 2e-5 * np.abs(slow).max()
    np.testing.assert_allclose(fast.coefficients, slow, rtol=0, atol=atol)
    # the copies of a vertex see the sky from one point, each above its own wall
    assert (signal > 0.0).sum() > 8


def test_vertices_without_normal_are_zero_and_counted(scene, accelerator, glossy, projection):
    normals, frames = scene.normals.copy(), scene.frames.copy()
    normals[[90, 95]] = 0.0
    frames[[90, 95]] = 0.0
    normals[97] = frames[97] = np.nan
    damaged = Scene(
        scene.positions, scene.faces, normals, frames, scene.areas, None,
        scene.part_ranges, scene.part_of_face,
    )  # fmt: skip
    block = bake_block(
        damaged, accelerator, (85, 100),
        factorisation=glossy, projection=projection, directions=CUBE,
    )  # fmt: skip
    assert block.counters()["vertices_without_normal"] == 3
    assert not block.coefficients[[5, 10, 12]].any()
    assert np.isfinite(block.coefficients).all()
    assert (block.signal_energy > 0).sum() == 12


def test_empty_block(scene, accelerator, glossy, projection):
    block = bake_block(
        scene, accelerator, (7, 7), factorisation=glossy, projection=projection, directions=CUBE
    )
    assert block.coefficients.shape == (0, glossy.n_terms, 162)
    assert block.n_rays == 0


def test_progress_counts_up_and_may_stop_the_bake(scene, accelerator, diffuse, projection):
    seen = []
    settings = {"factorisation": diffuse, "projection": projection, "directions": CUBE}
    bake_block(
        scene, accelerator, (0, 200), progress=lambda *at: seen.append(at), threads=2, **settings
    )
    assert [total for _, total in seen] == [200] * len(seen)
    assert [done for done, _ in seen] == sorted({done for done, _ in seen})
    assert seen[-1] == (200, 200)

    def stop(done, total):
        raise InterruptedError

    for threads in (1, 2):
        with pytest.raises(InterruptedError):
            bake_block(scene, accelerator, (0, 200), progress=stop, threads=threads, **settings)


def test_bad_arguments_are_refused_by_name(scene, accelerator, diffuse, projection):
    with pytest.raises(SettingsError, match=r"vertex range 5\.\.99999"):
        bake_block(
            scene, accelerator, (5, 99999),
            factorisation=diffuse, projection=projection, directions=CUBE,
        )  # fmt: skip
    with pytest.raises(SettingsError, match="the projection is for 864 directions, not 24"):
        bake_block(
            scene, accelerator, (0, 5),
            factorisation=diffuse, projection=projection, directions=cube_directions(2),
        )  # fmt: skip
