"""All bounces of a block of coefficients against the series of the sparse operator."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.interreflection import bounce_series
from support.bounce_scenes import ball, bowl, opaque

N_RAYS, SEED, N_COEFFS = 64, 3, 20


@pytest.fixture(scope="module")
def surface():
    """A ball in a bowl."""
    return opaque(Scene.from_parts([ball(1, centre=(0.0, -0.6, 0.0), radius=0.3), bowl(8, 16)]))


@pytest.fixture(scope="module")
def diffuse():
    return factorise(Lambert(np.array([1.0])))


def positive(scene, factorisations):
    """Transfer as it comes: no coefficient negative, so that bounces do not cancel."""
    rng = np.random.default_rng(7)
    return [
        rng.random((stop - start, own.n_terms, N_COEFFS)).astype(np.float32)
        for (start, stop), own in zip(scene.part_ranges, factorisations, strict=True)
    ]


def bounced(surface, direct, factorisations, albedo, **changes):
    settings = {"max_bounces": 30, "tolerance": 1e-6, "n_channels": albedo.n_channels} | changes
    return bounce_block(
        surface, direct, factorisations=factorisations, albedo=albedo,
        n_rays=[N_RAYS] * len(direct), seed=SEED, **settings,
    )  # fmt: skip


def missed(scene, full, cut):
    """Squared norm of what one lacks of the other, a part each."""
    return np.array(
        [
            float(scene.areas[start:stop] @ ((a - b) ** 2).sum(axis=(1, 2, 3)))
            for (start, stop), a, b in zip(scene.part_ranges, full.added, cut.added, strict=True)
        ]
    )


@pytest.mark.parametrize("colour", [(0.6,), (0.8, 0.4, 0.1)])
def test_diffuse_bounces_are_the_series_of_the_sparse_operator(surface, diffuse, colour):
    scene, albedo = surface.scene, Albedo.constant(*colour)
    direct = positive(scene, [diffuse] * 2)
    found = bounced(
        surface, direct, [diffuse] * 2, albedo, tolerance=0.0, max_bounces=12, rounds=[0, 0]
    )
    operator = build_bounce_block(
        surface, (0, scene.n_vertices), albedo=albedo, n_rays=N_RAYS, seed=SEED
    )
    whole = np.concatenate(direct)[:, 0]
    series = bounce_series(
        whole, operator.matrices, areas=scene.areas, tolerance=0.0, max_bounces=12
    )
    expected = (series.transfer - whole).transpose(1, 0, 2)
    # float32 sums in another order, over 12 bounces
    np.testing.assert_allclose(
        np.concatenate(found.added)[:, :, 0], expected, atol=2e-5 * expected.max()
    )
    assert expected.max() > 0.1
    shares = found.bounce_energies.sum(axis=1) / found.total_energy.sum()
    np.testing.assert_allclose(shares[-1], series.report.added[-1], rtol=1e-3)
    assert found.is_bound
    assert series.report.remainder is not None
    left = found.remainder_energy.sum() / found.total_energy.sum()
    assert left <= series.report.remainder * 1.001


def test_bounces_stop_after_the_first_that_no_part_needs(surface, diffuse):
    albedo, direct = Albedo.constant(0.6), positive(surface.scene, [diffuse] * 2)
    found = bounced(surface, direct, [diffuse] * 2, albedo, tolerance=1e-4)
    shares = (found.bounce_energies / found.total_energy).max(axis=1)
    assert shares[-1] <= 1e-4 < shares[-2]


def test_the_bound_holds_what_is_left_out(surface, diffuse):
    albedo, direct = Albedo.constant(0.7), positive(surface.scene, [diffuse] * 2)
    full = bounced(surface, direct, [diffuse] * 2, albedo, tolerance=1e-12, max_bounces=60)
    for n in (1, 2, 4):
        cut = bounced(surface, direct, [diffuse] * 2, albedo, tolerance=0.0, max_bounces=n)
        assert len(cut.bounce_energies) == n
        missing = missed(surface.scene, full, cut)
        assert (0.1 * cut.remainder_energy < missing).all()
        assert (missing <= 1.001 * cut.remainder_energy).all()


def test_the_estimate_for_glossy_parts_is_of_the_right_size(surface, diffuse):
    brdf = CookTorrance(np.array([0.3]), np.array([0.6]), 0.4, np.array([0.2]))
    glossy = factorise(brdf, n_terms=5, n_theta=12, n_phi=32)
    parts = [glossy, diffuse]
    # light of one direction a coefficient, so that the terms are those of a real surface
    scene = surface.scene
    towards = np.random.default_rng(1).normal(size=(N_COEFFS, 3))
    towards[:, 1] = np.abs(towards[:, 1])
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    direct = []
    for (start, stop), own in zip(scene.part_ranges, parts, strict=True):
        local = np.einsum("vij,cj->vci", scene.frames[start:stop], towards)
        psi = own.eval_psi(local.reshape(-1, 3)).reshape(*local.shape[:2], -1)
        direct.append((psi * np.maximum(local[..., 2:], 0.0)).transpose(0, 2, 1).astype(np.float32))
    albedo = Albedo.of_vertices(
        scene.faces,
        np.where(np.arange(scene.n_vertices) < scene.part_ranges[1][0], 1.0, 0.6)[:, None],
    )
    full, cut = (
        bounced(surface, direct, parts, albedo, rounds=[0, 0], **own)
        for own in (
            {"tolerance": 1e-12, "max_bounces": 40}, {"tolerance": 0.0, "max_bounces": 3},
        )
    )  # fmt: skip
    missing = missed(scene, full, cut)
    assert not cut.is_bound
    assert 0.5 * missing.sum() < cut.remainder_energy.sum() < 2.0 * missing.sum()
    # the noise of 64 rays against the same bounce from sixteen times as many
    one = bounced(surface, direct, parts, albedo, tolerance=0.0, max_bounces=1)
    many = bounce_block(
        surface, direct, factorisations=parts, albedo=albedo, n_channels=1,
        n_rays=[1024] * len(direct), seed=99, max_bounces=1, tolerance=0.0,
    )  # fmt: skip
    error = missed(scene, one, many)
    # of 128 vertices a part, and stratified rays gain more than the square root
    assert (0.4 * error < one.noise_energy).all()
    assert (one.noise_energy < 2.5 * error).all()
    assert (many.noise_energy < 0.2 * one.noise_energy).all()


def test_a_closed_white_room_has_no_bound(diffuse):
    """A furnace whose light never gets out: no power of F takes any of it away."""
    room = opaque(Scene.from_parts([ball(2, inward=True)]))
    direct = [np.ones((room.scene.n_vertices, 1, 2), np.float32)]
    found = bounced(room, direct, [diffuse], Albedo.constant(1.0), max_bounces=4)
    assert found.remainder_energy is None
    grey = bounced(room, direct, [diffuse], Albedo.constant(0.5), max_bounces=4)
    # from radiance 1 everywhere each bounce is half of the one before: 1/16 is left after four
    expected = room.scene.areas.sum() * 2 / 16**2
    np.testing.assert_allclose(grey.remainder_energy, expected, rtol=1e-3)


def test_black_surfaces_and_open_ones_add_nothing(diffuse):
    alone = opaque(Scene.from_parts([ball(1)]))
    direct = positive(alone.scene, [diffuse])
    for albedo in (Albedo.constant(0.0), Albedo.constant(0.9)):
        found = bounced(alone, direct, [diffuse], albedo)
        assert found.bounce_energies.tolist() == [[0.0]]
        assert (found.remainder_energy.tolist(), found.noise_energy.tolist()) == ([0.0], [0.0])
        assert not found.added[0].any()


def test_what_does_not_fit_is_refused(surface, diffuse):
    direct = positive(surface.scene, [diffuse] * 2)
    with pytest.raises(SettingsError, match="max_bounces"):
        bounced(surface, direct, [diffuse] * 2, Albedo.constant(0.5), max_bounces=-1)
    with pytest.raises(SettingsError, match="tolerance"):
        bounced(surface, direct, [diffuse] * 2, Albedo.constant(0.5), tolerance=-1.0)


@pytest.mark.parametrize(
    ("depth", "rays", "later", "allowed"),
    [(0.0, 64, 16, 0.0), (0.0, 64, 64, 5e-4), (2.2, 64, 64, 5e-4), (2.8, 64, 16, 5e-4)],
)
def test_the_error_of_all_bounces_is_measured_of_what_is_kept(diffuse, depth, rays, later, allowed):
    """Bounces share rays: in a deep bowl their errors add up, and the first tells little of them."""
    mesh = bowl(10, 24, depth_rad=depth) if depth else bowl(10, 24)
    deep = opaque(Scene.from_parts([mesh]))
    scene, albedo = deep.scene, Albedo.constant(0.8)
    # spots of light
    towards = np.random.default_rng(5).normal(size=(6, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    around = scene.positions - scene.positions.mean(axis=0)
    around /= np.linalg.norm(around, axis=1, keepdims=True)
    direct = [np.maximum(around @ towards.T - 0.7, 0.0)[:, None].astype(np.float32)]
    settings = {"factorisations": [diffuse], "albedo": albedo, "n_channels": 1, "max_bounces": 20,
                "tolerance": 1e-5}  # fmt: skip
    exact = bounce_block(
        deep, direct, n_rays=[2048], seed=999, rounds=[0], **(settings | {"tolerance": 1e-9})
    )
    told, true = [], []
    for seed in (0, 10, 20, 30):
        found = bounce_block(
            deep, direct, n_rays=[rays], later_rays=[later], noise_tolerance=allowed, seed=seed,
            **settings,
        )  # fmt: skip
        told.append(found.noise_energy[0])
        true.append(missed(scene, exact, found)[0])
    # what bounces hand on of their errors is told as if each drew anew, a standard error is added
    assert np.mean(true) < 1.5 * np.mean(told)
    assert np.mean(told) < 4.0 * np.mean(true)
