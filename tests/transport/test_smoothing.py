"""Means over neighbours: what they keep, what frames do to them, and what they gain."""

from dataclasses import replace

import numpy as np
import pytest

from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.ward import Ward
from prtbake_workers.geometry.mesh import Mesh
from prtbake_workers.geometry.scene import Scene, bodies_of
from prtbake_workers.transport.smoothing import ROUNDS, SHARPNESS, Smoothing
from support.bounce_scenes import ball, patch

DIFFUSE = factorise(Lambert(np.array([0.7])))
GLOSSY = factorise(
    CookTorrance(np.array([0.3]), np.array([0.6]), 0.4, np.array([0.2])),
    n_terms=5, n_theta=12, n_phi=32,
)  # fmt: skip
FLOOR = patch([-1.0, 0.0, 1.0], [2.0, 0.0, 0.0], [0.0, 0.0, -2.0], 6, 6)


def smoothed(scene, factorisation, values, rounds=1):
    return Smoothing.of_part(scene, 0, factorisation).apply(values[:, None], rounds)[:, 0]


def of_lobe(scene, factorisation, lobe):
    """The terms of one direction, the same in the world wherever it is looked at from."""
    local = scene.frames @ lobe
    return factorisation.eval_psi(local).astype(np.float32)[:, :, None]


def test_a_mean_is_that_of_the_one_ring_by_area_and_normals():
    scene = Scene.from_parts([ball(2)])
    values = np.random.default_rng(1).random((scene.n_vertices, 1, 3)).astype(np.float32)
    found = smoothed(scene, DIFFUSE, values)
    for vertex in (0, 17, 101):
        ring = np.unique(scene.faces[(scene.faces == vertex).any(axis=1)])
        weights = scene.areas[ring] * (scene.normals[ring] @ scene.normals[vertex]) ** SHARPNESS
        expected = weights @ values[ring, 0] / weights.sum()
        np.testing.assert_allclose(found[vertex, 0], expected, rtol=1e-5)
        # negative twin: the vertex by itself
        assert np.abs(values[vertex, 0] - expected).max() > 1e-2


def test_several_rounds_are_one_after_the_other_here_and_at_some_vertices():
    scene = Scene.from_parts([ball(2)])
    values = np.random.default_rng(2).random((scene.n_vertices, 2, 5, 3)).astype(np.float32)
    smoothing = Smoothing.of_part(scene, 0, GLOSSY)
    chosen = np.array([3, 40, 40, 150])
    whole = values
    for number in range(1, max(ROUNDS) + 1):
        whole = smoothing.apply(whole, 1)
        # sums in another order
        np.testing.assert_allclose(
            smoothing.at(chosen, number).apply(values), whole[chosen], atol=2e-6
        )
    np.testing.assert_array_equal(smoothing.at(chosen, 0).apply(values), values[chosen])
    around, means = smoothing.around(chosen)
    assert len(around) < scene.n_vertices
    np.testing.assert_allclose(
        means.apply(values[around]), smoothing.apply(values, 1)[chosen], atol=2e-6
    )


@pytest.mark.parametrize("factorisation", [DIFFUSE, GLOSSY], ids=["diffuse", "glossy"])
def test_what_is_even_on_a_plane_stays_whatever_the_frames(factorisation):
    """A direction has the same terms all over a plane; turned frames write them otherwise."""
    lobe = np.array([0.48, 0.6, 0.64])
    for seed in (None, 5):
        scene = Scene.from_parts([FLOOR], frame_seed=seed)
        values = of_lobe(scene, factorisation, lobe)
        np.testing.assert_allclose(
            smoothed(scene, factorisation, values, 4), values, atol=1e-5 * np.abs(values).max()
        )
    if factorisation is GLOSSY:
        # negative twin: means of the numbers, as if the frames were one
        unturned = Smoothing.of_part(scene, 0, DIFFUSE).weights @ values[:, :, 0]
        assert np.abs(unturned - values[:, :, 0]).max() > 0.05 * np.abs(values).max()


def test_turning_the_frames_turns_the_means_along():
    """On a curved surface as well: the means of turned terms are the turned means."""
    lobe = np.array([0.6, 0.48, 0.64])
    kept = []
    for seed in (None, 7):
        scene = Scene.from_parts([ball(2)], frame_seed=seed)
        found = smoothed(scene, GLOSSY, of_lobe(scene, GLOSSY, lobe))[:, :, 0]
        # by the radiance that they send towards one viewer, which no frame changes
        towards = scene.frames @ np.array([0.64, 0.6, 0.48])
        kept.append((found * GLOSSY.eval_phi(towards)[:, :, 0]).sum(axis=1))
    np.testing.assert_allclose(kept[0], kept[1], atol=2e-5 * np.abs(kept[0]).max())
    assert np.ptp(kept[0]) > 1e-3


def test_creases_seams_and_borders():
    # a floor and a wall that meet at vertices of their own: no mean goes round the corner
    wall = patch([-1.0, 0.0, -1.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], 6, 6)
    joined = Mesh(
        np.concatenate([FLOOR.positions, wall.positions]),
        np.concatenate([FLOOR.faces, wall.faces + FLOOR.n_vertices]).astype(np.int32),
        np.concatenate([FLOOR.normals, wall.normals]),
    )
    scene = Scene.from_parts([joined])
    step = np.zeros((scene.n_vertices, 1, 1), np.float32)
    step[FLOOR.n_vertices :] = 1.0
    np.testing.assert_allclose(smoothed(scene, DIFFUSE, step, 4), step, atol=1e-6)
    # a seam of coordinates cuts the floor in two: its copies see both sides, and stay alike
    left = patch([-1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -2.0], 3, 6)
    right = patch([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -2.0], 3, 6)
    halves = Mesh(
        np.concatenate([left.positions, right.positions]),
        np.concatenate([left.faces, right.faces + left.n_vertices]).astype(np.int32),
        np.concatenate([left.normals, right.normals]),
    )
    seam = Scene.from_parts([halves])
    values = seam.positions[:, :1, None].astype(np.float32)
    found = smoothed(seam, DIFFUSE, values, 1)[:, 0, 0]
    middle = np.flatnonzero(np.abs(halves.positions[:, 0]) < 1e-9)
    assert len(middle) == 14
    by_height = middle[np.lexsort((middle, halves.positions[middle, 2]))].reshape(7, 2)
    np.testing.assert_array_equal(found[by_height[:, 0]], found[by_height[:, 1]])
    # negative twin: either side by itself sees nothing beyond the seam
    alone = Scene.from_parts([left])
    edge = np.flatnonzero(np.abs(left.positions[:, 0]) < 1e-9)
    one_sided = smoothed(alone, DIFFUSE, alone.positions[:, :1, None].astype(np.float32))
    assert (one_sided[edge, 0, 0] < found[middle].min() - 0.02).all()
    # a border of two parts of one body: either copy would see its own side alone, so both keep
    parts = Scene.from_parts([left, right], bodies=bodies_of(["object", "object"]))
    values = np.random.default_rng(4).random((left.n_vertices, 1, 2)).astype(np.float32)
    kept = smoothed(parts, DIFFUSE, values)
    border = np.abs(left.positions[:, 0]) < 1e-9
    np.testing.assert_array_equal(kept[border], values[border])
    assert (kept[~border] != values[~border]).all()


def test_chance_falls_by_the_number_of_neighbours():
    scene = Scene.from_parts([ball(3)])
    noise = np.random.default_rng(6).standard_normal((scene.n_vertices, 1, 64)).astype(np.float32)
    for rounds, least in ((1, 6.0), (2, 10.0), (4, 20.0)):
        left = float((smoothed(scene, DIFFUSE, noise, rounds) ** 2).mean())
        assert least < 1.0 / left < 2.0 * least


def test_terms_of_an_anisotropic_brdf_are_left_alone():
    brushed = factorise(
        Ward(np.array([0.2]), np.array([0.3]), 0.6, 0.3), n_terms=4, n_theta=8, n_phi=16
    )
    assert Smoothing.of_part(Scene.from_parts([ball(1)]), 0, brushed) is None


def test_vertices_that_no_face_or_area_holds_keep_their_values():
    scene = Scene.from_parts([ball(1)])
    scene = replace(scene, areas=np.zeros_like(scene.areas))
    values = np.random.default_rng(8).random((scene.n_vertices, 1, 2)).astype(np.float32)
    np.testing.assert_array_equal(smoothed(scene, DIFFUSE, values, 2), values)


@pytest.mark.parametrize("missing", [0.0, np.nan])
def test_a_vertex_without_a_normal_takes_part_in_no_mean(missing):
    normals = ball(1).normals.copy()
    normals[5] = missing
    scene = Scene.from_parts([replace(ball(1), normals=normals)])
    values = np.random.default_rng(9).random((scene.n_vertices, 5, 2)).astype(np.float32)
    values[5] = 0.0
    found = smoothed(scene, GLOSSY, values, 2)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found[5], values[5])
    beyond = values.copy()
    beyond[5] = 1e6
    np.testing.assert_array_equal(
        np.delete(smoothed(scene, GLOSSY, beyond, 2), 5, 0), np.delete(found, 5, 0)
    )
