"""The decision on scattering inside: against the sphere's own eigenvalues, and at both ends."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import eval_legendre

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning import subsurface
from prtbake_workers.planning.subsurface import decide_subsurface, probe_scattering
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.subsurface import SubsurfaceOperator
from support.bounce_scenes import ball, opaque, patch

COSINE = np.array([np.pi, 2.0 * np.pi / 3.0, np.pi / 4.0, 0.0, -np.pi / 24.0])
"""Of the clamped cosine in zonal harmonics [Ramamoorthi and Hanrahan 2001], bands 0 to 4."""


def marble(path):
    """With its red mean free path at so many scene units."""
    one = Dipole.of_material("marble", mm_per_unit=1.0)
    return Dipole.of_material("marble", mm_per_unit=one.mean_free_path[0] / path)


def share_on_the_unit_sphere(dipole):
    """S multiplies band l of a sphere by F 2 pi integral R_d(2 sin(t / 2)) P_l(cos t) sin t dt."""
    wrong = total = 0.0
    for channel, albedo in enumerate(dipole.diffuse_albedo):
        for band, cosine in enumerate(COSINE):

            def integrand(angle, channel=channel, band=band):
                chord = np.array([2.0 * np.sin(0.5 * angle)])
                profile = float(dipole.profile(chord)[channel, 0])
                return profile * eval_legendre(band, np.cos(angle)) * np.sin(angle)

            near = float(dipole.mean_free_path[channel])
            points = [x for x in (near, 5.0 * near, 30.0 * near) if x < np.pi]
            value = quad(integrand, 0.0, np.pi, points=points, limit=200)[0]
            eigen = 2.0 * np.pi * dipole.entering_transmittance * value
            # energies over the sphere and the coefficients: 2 l + 1 of them, all alike
            weight = (2 * band + 1) * cosine**2
            wrong += weight * (eigen - albedo) ** 2
            total += weight * eigen**2
    return wrong / total


@pytest.fixture(scope="module")
def sphere():
    return opaque(Scene.from_parts([ball(4)]))


@pytest.mark.parametrize("path", [0.02, 0.1, 0.5])
def test_the_probe_finds_the_share_of_the_sphere(sphere, path):
    dipole = marble(path)
    expected = share_on_the_unit_sphere(dipole)
    probe = probe_scattering(sphere, 0, dipole, seed=2)
    # facets of 1/16 and 512 points; the shares lie decades apart
    assert probe.share == pytest.approx(expected, rel=0.15)
    assert probe.resolution[0] == pytest.approx(path / np.sqrt(4.0 * np.pi / 2562), rel=0.01)
    # negative twin: the medium of another path
    assert share_on_the_unit_sphere(marble(1.3 * path)) > 1.2 * expected


def test_the_noise_of_the_rays_does_not_look_like_scattering(sphere, monkeypatch):
    """A path so short that nothing moves: the halves' product keeps the share at zero."""
    dipole = marble(1e-4)
    shares = [probe_scattering(sphere, 0, dipole, seed=seed).share for seed in range(4)]
    assert max(shares) < 3e-4
    # negative twin: with one half multiplied by itself the noise adds up
    halves = iter(range(100))
    rays = subsurface._transfer
    kept = {}

    def same(surface, span, rng):
        key = next(halves) // 2
        if key not in kept:
            kept[key] = rays(surface, span, rng)
        return kept[key]

    monkeypatch.setattr(subsurface, "_transfer", same)
    monkeypatch.setattr(subsurface, "RAYS", 4)
    assert probe_scattering(sphere, 0, marble(0.05), seed=0).share > 2.0 * share_on_the_unit_sphere(
        marble(0.05)
    )


def decide(surface, media, switch="auto", tolerance=1e-3):
    return decide_subsurface(
        surface, media, BakeSettings(subsurface_tolerance=tolerance), switch, seed=0
    )


@pytest.mark.parametrize(
    ("path", "taken"), [(1e-6, False), (1e-3, False), (0.1, True), (1e6, True)]
)
def test_paths_from_far_below_the_object_to_far_beyond_it(sphere, path, taken):
    found = decide(sphere, [marble(path)])
    assert found.decision.taken == taken
    assert found.parts == ((0,) if taken else ())
    assert np.isfinite(found.decision.predicted_error_otherwise)
    assert all(np.isfinite(found.decision.evidence[name]).all() for name in ("share", "albedo"))


def test_every_part_is_decided_by_itself():
    scene = Scene.from_parts(
        [ball(3), ball(3, centre=(3.0, 0.0, 0.0)), ball(2, centre=(0.0, 3.0, 0.0))]
    )
    found = decide(opaque(scene), [marble(1e-6), marble(0.3), None])
    assert found.parts == (1,)
    assert found.decision.taken
    low, high = found.decision.evidence["share"]
    assert low < 1e-3 < high
    assert found.decision.predicted_error_otherwise == high


def test_the_rim_of_a_plane_counts_by_its_area():
    """A path too short to leave the rim's cells: points see it less often than vertices do."""
    plane = patch([-2, 0, 2], [4, 0, 0], [0, 0, -4], 16, 16)
    alone = opaque(Scene.from_parts([plane]))
    dipole = marble(1e-3)
    assert probe_scattering(alone, 0, dipole, seed=1).share < 1e-3
    # negative twin: probed at vertices, half of the light of a quarter of them is missing
    operator = SubsurfaceOperator(alone.scene, dipole)
    (row, *_) = operator.block(np.arange(alone.scene.n_vertices)).matrices
    even = row @ operator.sources(np.ones((alone.scene.n_vertices, 1), np.float32))[:, 0]
    wrong = (even - dipole.diffuse_albedo[0]) ** 2
    assert wrong.sum() > 0.05 * (even**2).sum()


def test_switches_force_both_ways(sphere):
    on = decide(sphere, [marble(1e-6)], "on")
    assert (on.decision.taken, on.decision.forced, on.parts) == (True, True, (0,))
    off = decide(sphere, [marble(0.3)], "off")
    assert (off.decision.taken, off.decision.forced, off.parts) == (False, True, ())
    assert off.decision.predicted_error_otherwise > 0.01
    assert "otherwise" in off.decision.reason
    nothing = decide(sphere, [None], "on")
    assert (nothing.decision.taken, nothing.parts) == (False, ())
    assert decide(sphere, [marble(0.1)], tolerance=0.9).parts == ()


def test_black_and_white_media(sphere):
    black = Dipole(np.array([0.0]), np.array([3.0]), 1.3)
    assert decide(sphere, [black]).decision.predicted_error_otherwise == 0.0
    white = Dipole(np.array([20.0]), np.array([0.0]), 1.3)
    probe = probe_scattering(sphere, 0, white, seed=0)
    assert probe.albedo[0] == pytest.approx(white.entering_transmittance)
    assert probe.share == pytest.approx(share_on_the_unit_sphere(white), rel=0.15)
