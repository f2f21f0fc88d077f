"""Rays follow their noise: the probe tells it, and those chosen keep to half of the tolerance."""

import numpy as np
import pytest

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.basis.srbf import SrbfBasis
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.icosphere import icosphere
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.bounce_rays import (
    FEWEST,
    NOISE_SHARE,
    bounce_rays,
    later_rays,
    pilot_tolerance,
)
from prtbake_workers.planning.decision import Decision
from prtbake_workers.planning.interreflection import probe_bounce
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bake import bake_block
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.directions import cube_directions
from support.bounce_scenes import ball, bowl, opaque, patch

DIFFUSE = factorise(Lambert(np.array([1.0])))
CUBE = cube_directions(8)
WHITE = Albedo.constant(0.9)
SCENES = {
    "ball on a floor": lambda: [
        ball(2, centre=(0.0, 1.02, 0.0)),
        patch([-2.0, 0.0, 2.0], [4.0, 0.0, 0.0], [0.0, 0.0, -4.0], 12, 12),
    ],
    "bowl": lambda: [bowl(8, 16)],
}


@pytest.fixture(scope="module", params=SCENES)
def baked(request):
    """A scene and its direct transfer."""
    surface = opaque(Scene.from_parts(SCENES[request.param]()))
    projection = SrbfBasis(icosphere(1)).projection(CUBE.directions, CUBE.weights)
    direct = [
        bake_block(
            surface.scene, surface.accelerator, span, factorisation=DIFFUSE,
            projection=projection, directions=CUBE,
        ).coefficients
        for span in surface.scene.part_ranges
    ]  # fmt: skip
    return surface, direct


def first_bounce(baked, n_rays, seed):
    """With n_rays a vertex, or a number a part."""
    surface, direct = baked
    n_rays = np.broadcast_to(n_rays, len(direct)).tolist()
    return bounce_block(
        surface, direct, factorisations=[DIFFUSE] * len(direct), albedo=WHITE, n_channels=1,
        n_rays=n_rays, seed=seed, max_bounces=1, tolerance=0.0,
        rounds=[0] * len(direct),
    )  # fmt: skip


@pytest.fixture(scope="module")
def exact(baked):
    """The first bounce with far more rays than any that is held against it."""
    return first_bounce(baked, 2048, 99)


def true_noise(baked, exact, n_rays):
    """Squared error of the first bounce over direct energy, a part each, from the bounce itself."""
    scene = baked[0].scene
    errors = []
    for seed in range(4):
        found = first_bounce(baked, n_rays, seed)
        errors.append(
            [
                float(scene.areas[start:stop] @ ((a - b).astype(np.float64) ** 2).sum((1, 2, 3)))
                for (start, stop), a, b in zip(
                    scene.part_ranges, found.added, exact.added, strict=True
                )
            ]
        )
    return np.mean(errors, axis=0) / exact.direct_energy


@pytest.fixture(scope="module")
def probed(baked):
    """Variance of one ray, a part each, by the probe."""
    surface, direct = baked
    return np.array(
        [
            np.mean(
                [
                    probe_bounce(surface, part, [DIFFUSE] * len(direct), WHITE, seed=s).variance
                    for s in range(4)
                ]
            )
            for part in range(len(direct))
        ]
    )


def decided(*variances, forced=False, share=0.1):
    evidence = {"variances": variances, "first_bounce_share": share}
    return Decision("interreflection", True, forced, "", evidence)


def test_the_probe_tells_the_noise_of_one_ray(baked, exact, probed):
    # the coarse vertices of the floor near the ball hold most of its variance
    np.testing.assert_allclose(probed, true_noise(baked, exact, 1), rtol=0.35)


@pytest.mark.parametrize("tolerance", [8e-3, 2e-3])
def test_the_rays_chosen_keep_to_their_share_of_the_tolerance(baked, exact, probed, tolerance):
    bake = BakeSettings(bounce_rays=4096, bounce_tolerance=tolerance)
    n_rays = np.array(bounce_rays(decided(*probed), bake))
    allowed = NOISE_SHARE * tolerance
    assert (true_noise(baked, exact, n_rays) < allowed).all()
    # and no more of them than that asks for: the lattice is at most so much better than assumed
    assert ((n_rays == FEWEST) | (true_noise(baked, exact, n_rays // 4) > allowed)).all()


def test_no_more_rays_than_asked_for_and_all_where_bounces_are_forced():
    bake = BakeSettings(bounce_rays=64, bounce_tolerance=1e-3)
    assert bounce_rays(decided(1.0, 0.0), bake) == (64, FEWEST)
    assert bounce_rays(decided(0.0), BakeSettings(bounce_rays=4)) == (4,)
    assert bounce_rays(decided(0.0, 0.0, forced=True), bake) == (64, 64)
    assert bounce_rays(decided(0.0), BakeSettings(bounce_rays=64, bounce_tolerance=0.0)) == (64,)
    counts = bounce_rays(decided(*np.geomspace(1e-5, 1.0, 40)), bake)
    assert counts == tuple(sorted(counts))
    assert set(counts) > {FEWEST, 64}


def test_later_bounces_take_fewer_rays_the_less_they_bring():
    bake = BakeSettings(bounce_rays=64, bounce_tolerance=1e-3)
    shares = (1e-4, 1e-2, 0.05, 0.1, 0.25, 0.9)
    counts = [later_rays(decided(1.0, share=share), bake, (64, 20))[0] for share in shares]
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (FEWEST, 64)
    # by the power that noise falls with, its second bounce adds a quarter of the first one's
    assert counts[3] == 33
    assert pytest.approx(0.25, rel=0.05) == 0.1 * (64 / 33) ** (4 / 3)
    assert later_rays(decided(1.0, share=0.1, forced=True), bake, (64, 20)) == (64, 20)


def test_one_bounce_may_err_by_what_a_series_of_them_adds_up_to():
    """Their amplitudes add: 1 + 1/2 + 1/4 + ... = 2 at a quarter of the energy."""
    bake = BakeSettings(bounce_tolerance=1e-3)
    series = sum(0.5**k for k in range(60)) ** 2
    allowed = pilot_tolerance(decided(1.0, share=0.25), bake)
    assert allowed * series == pytest.approx(NOISE_SHARE * 1e-3, rel=1e-9)
    assert pilot_tolerance(decided(1.0, share=1.0), bake) == 0.0
    assert pilot_tolerance(decided(1.0, share=0.1, forced=True), bake) == 0.0
