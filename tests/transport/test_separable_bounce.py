"""The matrix-free bounce against the sparse operator, a slow twin and the law of energy."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.frames import tangent_frames
from prtbake_workers.geometry.ray_offset import offset_origins, ray_epsilon
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice, shifted, shifts
from prtbake_workers.transport.separable_bounce import BounceGather
from prtbake_workers.transport.surface import OpaqueSurface
from support.bounce_scenes import ball, patch

N_RAYS, SEED, N_COEFFS = 64, 5, 70


@pytest.fixture(scope="module")
def scene():
    """A ball close above a floor."""
    floor = patch([-2.0, 0.0, 2.0], [4.0, 0.0, 0.0], [0.0, 0.0, -4.0], 6, 6)
    return Scene.from_parts([ball(2, centre=(0.0, 1.1, 0.0)), floor], frame_seed=2)


@pytest.fixture(scope="module")
def accelerator(scene):
    return Accelerator(scene.positions, scene.faces)


@pytest.fixture(scope="module")
def diffuse():
    return factorise(Lambert(np.array([1.0])))


@pytest.fixture(scope="module")
def glossy():
    brdf = CookTorrance(np.array([0.3]), np.array([0.7]), 0.5, np.array([0.1]))
    return factorise(brdf, n_terms=7, n_theta=12, n_phi=32)


def transfers(rng, scene, factorisations, channels=1):
    return [
        rng.standard_normal((stop - start, channels, own.n_terms, N_COEFFS)).astype(np.float32)
        for (start, stop), own in zip(scene.part_ranges, factorisations, strict=True)
    ]


def prepared(scene, accelerator, part, span, factorisations, albedo, channels=1, n_rays=N_RAYS):
    return BounceGather(
        OpaqueSurface(scene, accelerator), part, np.arange(*span), factorisations=factorisations,
        albedo=albedo, n_channels=channels, n_rays=n_rays, seed=SEED,
    )  # fmt: skip


@pytest.mark.parametrize("channels", [1, 3])
def test_diffuse_parts_bounce_as_the_sparse_operator_does(
    rng, scene, accelerator, diffuse, channels
):
    values = rng.random((scene.n_vertices, channels)) * 0.9
    albedo = Albedo.of_vertices(scene.faces, values)
    sent = transfers(rng, scene, [diffuse, diffuse], channels)
    block = build_bounce_block(
        OpaqueSurface(scene, accelerator),
        (0, scene.n_vertices),
        albedo=albedo,
        n_rays=N_RAYS,
        seed=SEED,
    )
    stacked = np.concatenate(sent)[:, :, 0]
    for part, (start, stop) in enumerate(scene.part_ranges):
        found = prepared(
            scene, accelerator, part, (start, stop), [diffuse] * 2, albedo, channels
        ).apply(sent)
        for channel in range(channels):
            expected = block.matrices[channel] @ stacked[:, channel]
            # float32 sums over at most 64 rays x 3 corners, in another order
            np.testing.assert_allclose(found[:, channel, 0], expected[start:stop], atol=2e-5)
    assert np.abs(block.matrices[0] @ stacked[:, 0]).max() > 0.1


def slow_twin(scene, accelerator, part, vertex, factorisations, values, sent):
    """One vertex, ray by ray, in float64; albedo by vertex, one channel."""
    local = cosine_directions(shifted(lattice(N_RAYS), shifts(SEED, vertex, vertex + 1, 2)))[0]
    frame = tangent_frames(scene.normals[vertex : vertex + 1])[0]
    world = (local @ frame).astype(np.float32)
    local = local @ frame @ scene.frames[vertex].T
    origin = offset_origins(
        scene.ray_points[vertex : vertex + 1], scene.ray_sides[vertex : vertex + 1],
        ray_epsilon(scene.bounds),
    )  # fmt: skip
    hits = accelerator.intersect(np.repeat(origin, N_RAYS, axis=0), world)
    total = np.zeros((factorisations[part].n_terms, N_COEFFS))
    for i in np.flatnonzero(hits.triangles >= 0):
        corners = scene.faces[hits.triangles[i]]
        a, b, c = scene.positions[corners]
        if np.cross(b - a, c - a) @ world[i] >= 0.0:
            continue
        other = int(scene.part_of_face[hits.triangles[i]])
        weight = hits.barycentrics[i].astype(np.float64)
        radiance = np.zeros(N_COEFFS)
        for corner, share in zip(corners, weight / weight.sum(), strict=True):
            towards = -world[i].astype(np.float64)
            cosine = towards @ scene.normals[corner]
            if cosine < 1e-3:
                towards += (1e-3 - cosine) * scene.normals[corner]
                towards /= np.linalg.norm(towards)
            phi = np.ones(1)
            if not factorisations[other].is_constant_phi:
                phi = factorisations[other].eval_phi((scene.frames[corner] @ towards)[None])[
                    0, :, 0
                ]
            own = sent[other][corner - scene.part_ranges[other][0], 0].astype(np.float64)
            radiance += share * (phi @ own)
        radiance *= (weight / weight.sum()) @ values[corners, 0]
        total += np.outer(factorisations[part].eval_psi(local[i : i + 1])[0], radiance)
    return np.pi / N_RAYS * total


def test_glossy_parts_bounce_as_the_slow_twin_does(rng, scene, accelerator, diffuse, glossy):
    factorisations = [glossy, diffuse]
    values = np.ones((scene.n_vertices, 1))
    values[scene.part_ranges[1][0] :] = 0.4
    albedo = Albedo.of_vertices(scene.faces, values)
    sent = transfers(rng, scene, factorisations)
    checked = 0
    for part, (start, stop) in enumerate(scene.part_ranges):
        found = prepared(scene, accelerator, part, (start, stop), factorisations, albedo).apply(
            sent
        )
        for vertex in range(start, stop, 7):
            expected = slow_twin(scene, accelerator, part, vertex, factorisations, values, sent)
            np.testing.assert_allclose(
                found[vertex - start, 0],
                expected,
                atol=1e-4 * max(1.0, np.abs(expected).max()),
            )
            checked += np.abs(expected).max() > 0.01
    # lit vertices of both parts were among them
    assert checked > 10


def test_the_result_does_not_depend_on_the_block(rng, scene, accelerator, diffuse, glossy):
    factorisations = [glossy, diffuse]
    albedo = Albedo.constant(0.5)
    sent = transfers(rng, scene, factorisations)
    whole, *halves = (
        prepared(scene, accelerator, 0, span, factorisations, albedo)
        for span in ((0, 40), (0, 13), (13, 40))
    )
    np.testing.assert_array_equal(
        whole.apply(sent), np.concatenate([half.apply(sent) for half in halves])
    )
    assert whole.n_rays == sum(half.n_rays for half in halves)
    # nor on which coefficients are carried together: they do not mix
    columns = [whole.apply([one[..., part] for one in sent]) for part in (slice(9), slice(9, None))]
    np.testing.assert_allclose(np.concatenate(columns, axis=3), whole.apply(sent), atol=1e-5)


def test_turning_the_frames_turns_the_terms_and_nothing_else(rng, accelerator, diffuse, glossy):
    """Sent from a diffuse floor to a glossy ball: the energy of each vertex' terms is invariant."""
    floor = patch([-2.0, 0.0, 2.0], [4.0, 0.0, 0.0], [0.0, 0.0, -4.0], 6, 6)
    energies = []
    for frame_seed in (None, 9):
        turned = Scene.from_parts([ball(2, centre=(0.0, 1.1, 0.0)), floor], frame_seed=frame_seed)
        sent = transfers(np.random.default_rng(1), turned, [glossy, diffuse])
        sent[0][:] = 0.0
        found = prepared(
            turned, accelerator, 0, turned.part_ranges[0], [glossy, diffuse],
            Albedo.constant(0.5), n_rays=4096,
        ).apply(sent)  # fmt: skip
        energies.append((found.astype(np.float64) ** 2).sum(axis=(1, 2, 3)))
    lit = energies[0] > 1e-3 * energies[0].max()
    # the same rays: what is left is the tables' rounding
    np.testing.assert_allclose(energies[1][lit], energies[0][lit], rtol=1e-3)


def test_black_surfaces_send_nothing_and_no_ray_is_traced(rng, scene, accelerator, diffuse):
    sent = transfers(rng, scene, [diffuse, diffuse])
    black = Albedo.constant(0.0)
    found = prepared(scene, accelerator, 0, (0, 10), [diffuse] * 2, black)
    assert found.n_rays == 0
    assert not found.apply(sent).any()


def test_what_does_not_fit_is_refused(rng, scene, accelerator, diffuse):
    grey, red = Albedo.constant(0.5), Albedo.constant(0.5, 0.1, 0.1)
    with pytest.raises(SettingsError, match="vertex 0 is outside part 1"):
        prepared(scene, accelerator, 1, (0, 10), [diffuse] * 2, grey)
    with pytest.raises(SettingsError, match="surfaces have 3 channels, the transfer has 1"):
        prepared(scene, accelerator, 0, (0, 10), [diffuse] * 2, red)
    sent = transfers(rng, scene, [diffuse, diffuse])
    coloured = [sent[0], np.repeat(sent[1], 3, axis=1)]
    with pytest.raises(SettingsError, match="channels"):
        prepared(scene, accelerator, 0, (0, 10), [diffuse] * 2, grey).apply(coloured)
