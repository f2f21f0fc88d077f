"""Bounces: a needed one is not skipped, a skipped one changes less than the tolerance."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import BakeSettings, Effects
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.interreflection import (
    BounceProbe,
    all_bounces,
    decide_bounces,
    probe_bounce,
)
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.directions import cube_directions
from support.bounce_scenes import ball, bowl, opaque, patch

DIFFUSE = factorise(Lambert(np.array([1.0])))
GLOSSY = factorise(CookTorrance(np.array([0.4]), np.array([0.5]), 0.4, np.array([0.1])), n_terms=6)
CUBE = cube_directions(8)


def floor(y=0.0):
    return patch([-2.0, y, 2.0], [4.0, 0.0, 0.0], [0.0, 0.0, -4.0], 12, 12)


def true_shares(surface, factorisations, albedo, n_channels, max_bounces=20):
    """Bounced over direct energy of every part, from a bake and all bounces of 64 rays.

    With three channels also what their mean misses.
    """
    scene = surface.scene
    basis = SrbfBasis(icosphere(2), 15.0)
    projection = basis.projection(CUBE.directions, CUBE.weights)
    baked = [
        bake_block(
            scene, surface.accelerator, span, factorisation=own, projection=projection,
            directions=CUBE,
        )
        for span, own in zip(scene.part_ranges, factorisations, strict=True)
    ]  # fmt: skip
    block = bounce_block(
        surface, [own.coefficients for own in baked], factorisations=factorisations,
        albedo=albedo, n_channels=n_channels,
        n_rays=[64] * len(baked), seed=1, max_bounces=max_bounces, tolerance=1e-9,
    )  # fmt: skip
    shares = []
    for (start, stop), own, added in zip(scene.part_ranges, baked, block.added, strict=True):
        areas = scene.areas[start:stop]
        whole = n_channels * float(areas @ own.signal_energy)
        grey = added - added.mean(axis=1, keepdims=True)
        shares.append(
            [
                float(areas @ (x.astype(np.float64) ** 2).sum(axis=(1, 2, 3))) / whole
                for x in (added, grey)
            ]
        )
    return np.array(shares)


@pytest.mark.parametrize("glossy", [False, True])
def test_the_probe_predicts_what_bounces_add(glossy):
    own = GLOSSY if glossy else DIFFUSE
    surface = opaque(Scene.from_parts([ball(2, centre=(0.0, 1.02, 0.0)), floor()]))
    colours = [np.ones(3) if glossy else np.array([0.9, 0.3, 0.1]), np.array([0.2, 0.7, 0.2])]
    albedo = Albedo.of_parts(surface.scene, colours, [None, None])
    shares = true_shares(surface, [own, DIFFUSE], albedo, 3, max_bounces=1)
    for part in (0, 1):
        probes = [
            probe_bounce(surface, part, [own, DIFFUSE], albedo, seed=seed) for seed in range(4)
        ]
        # 16,384 rays leave a few per cent, order 5 drops a few more, and the receiver's share
        # comes from the few vertices at the ball
        share = np.mean([probe.share for probe in probes])
        assert share == pytest.approx(shares[part, 0], rel=0.2 if part == 0 else 0.4)
        chroma = np.mean([probe.chroma for probe in probes])
        assert chroma == pytest.approx(shares[part, 1], rel=0.2 if part == 0 else 0.5)


def decide(surface, factorisations, albedo, *, tolerance=1e-3, **requested):
    found = decide_bounces(
        surface.scene, surface, factorisations, albedo, BakeSettings(bounce_tolerance=tolerance),
        Effects(**requested), names=[f"part {i}" for i in range(len(factorisations))], seed=0,
    )  # fmt: skip
    return {decision.effect: decision for decision in found}


def test_a_convex_body_alone_and_black_surfaces_need_no_bounce():
    alone = opaque(Scene.from_parts([ball(3)]))
    found = decide(alone, [DIFFUSE], Albedo.constant(0.9))
    assert not found["interreflection"].taken
    assert found["interreflection"].predicted_error_otherwise == 0.0
    assert "no probe ray" in found["interreflection"].reason
    assert not found["colour_bleeding"].taken

    on_floor = opaque(Scene.from_parts([ball(2, centre=(0.0, 1.02, 0.0)), floor()]))
    black = decide(on_floor, [DIFFUSE] * 2, Albedo.constant(0.0))
    assert not black["interreflection"].taken
    assert "black" in black["interreflection"].reason
    assert decide(on_floor, [DIFFUSE] * 2, Albedo.constant(0.7))["interreflection"].taken


def test_what_is_skipped_is_below_the_tolerance_and_what_is_above_is_taken():
    surface = opaque(Scene.from_parts([ball(2, centre=(0.0, 1.02, 0.0)), floor()]))
    albedo = Albedo.constant(0.5)
    share = true_shares(surface, [DIFFUSE] * 2, albedo, 1)[:, 0].max()
    # 256 vertices of each part, and the bounces go on from part to part as the first
    predicted = decide(surface, [DIFFUSE] * 2, albedo)["interreflection"].predicted_error_otherwise
    assert share * 0.85 < predicted < 1.4 * share
    # where probes may err either way it is taken
    for tolerance, taken in ((0.5 * share, True), (1.1 * share, True), (4.0 * share, False)):
        found = decide(surface, [DIFFUSE] * 2, albedo, tolerance=tolerance)
        assert found["interreflection"].taken == taken


def probe_of(share, *sent):
    return BounceProbe(share, sent, 0.0, 0.5, 0.0, 1)


def test_bounces_go_on_from_part_to_part():
    # one part: a geometric series of amplitudes
    assert all_bounces([probe_of(0.25, 0.25)]) == pytest.approx([1.0])
    # of two that only light each other the amplitudes 0.3 and 0.04 alternate
    both = [probe_of(0.09, 0.0, 0.09), probe_of(0.0016, 0.0016, 0.0)]
    series = [(0.3 * (1 + 0.04)) / (1 - 0.012), (0.04 * (1 + 0.3)) / (1 - 0.012)]
    assert all_bounces(both) == pytest.approx(np.square(series))
    assert all_bounces([probe_of(0.0, 0.0)]) == pytest.approx([0.0])
    # a closed white room: no series, but a number
    assert np.isfinite(all_bounces([probe_of(1.0, 1.0)])).all()


def test_a_coloured_floor_bleeds_and_a_grey_one_does_not():
    surface = opaque(Scene.from_parts([ball(2, centre=(0.0, 1.02, 0.0)), floor()]))
    red = Albedo.of_parts(surface.scene, [np.full(3, 0.5), np.array([0.9, 0.1, 0.1])], [None] * 2)
    found = decide(surface, [DIFFUSE] * 2, red)
    assert found["colour_bleeding"].taken
    share = true_shares(surface, [DIFFUSE] * 2, red, 3)[:, 1].max()
    predicted = found["colour_bleeding"].predicted_error_otherwise
    # light that is red once grows redder, which the series does not know
    assert predicted == pytest.approx(share, rel=0.3)
    assert share > 1e-3
    grey = decide(surface, [DIFFUSE] * 2, Albedo.constant(0.5))
    assert not grey["colour_bleeding"].taken
    assert grey["colour_bleeding"].predicted_error_otherwise == 0.0


def test_effects_are_forced_both_ways():
    surface = opaque(Scene.from_parts([bowl(8, 16)]))
    on = decide(surface, [DIFFUSE], Albedo.constant(0.5), tolerance=0.9, interreflection="on")
    assert (on["interreflection"].taken, on["interreflection"].forced) == (True, True)
    off = decide(surface, [DIFFUSE], Albedo.constant(0.5), interreflection="off")["interreflection"]
    assert (off.taken, off.forced) == (False, True)
    # what the force costs is said
    assert off.predicted_error_otherwise > 0.03
    without = decide(
        surface, [DIFFUSE], Albedo.constant(0.5), interreflection="off", colour_bleeding="on"
    )["colour_bleeding"]
    assert not without.taken
    assert without.forced


def test_a_textures_colour_is_seen_where_rays_hit():
    scene = Scene.from_parts([floor()])
    texture = np.zeros((4, 8, 3), np.float32)
    texture[:, :4] = (0.8, 0.2, 0.2)
    texture[:, 4:] = 0.5
    albedo = Albedo.of_parts(scene, [np.ones(3)], [texture])
    assert albedo.n_channels == 3
    centre = scene.positions[scene.faces].mean(axis=1)
    middle = np.full((scene.faces.shape[0], 3), 1 / 3)
    found = albedo.checked_at(np.arange(len(middle)), middle)
    left = centre[:, 0] < -0.6
    np.testing.assert_allclose(
        found[left & (centre[:, 0] > -1.4)], [[0.8, 0.2, 0.2]] * 48, atol=1e-6
    )
    assert Albedo.of_parts(scene, [np.full(3, 0.3)], [None]).n_channels == 1
    np.testing.assert_allclose(
        albedo.greyed().checked_at(np.arange(len(middle)), middle)[:, 0],
        found.mean(axis=1),
        atol=1e-6,
    )
