"""Scattering inside a part, alone and between bounces, against dense linear algebra."""

import numpy as np
import pytest

from prtbake_storage.errors import SettingsError
from prtbake_workers.brdf.factorise import factorise
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.transport import part_scattering
from prtbake_workers.transport.albedo import Albedo
from prtbake_workers.transport.bounce_operator import build_bounce_block
from prtbake_workers.transport.bounces import bounce_block
from prtbake_workers.transport.dipole import Dipole
from prtbake_workers.transport.hat_moments import hat_moments
from prtbake_workers.transport.part_scattering import PartScattering, build_rows
from prtbake_workers.transport.subsurface import SubsurfaceOperator
from support.bounce_scenes import ball, bowl, opaque

N_RAYS, SEED, N_COEFFS = 64, 3, 12
DIFFUSE = factorise(Lambert(np.array([1.0])))
ALBEDO = Albedo.constant(0.8)
MEDIUM = Dipole(np.array([6.0, 5.0, 9.0]), np.array([0.1, 0.9, 2.0]), 1.4)


@pytest.fixture(scope="module")
def surface():
    """A ball that scatters light, in a bowl that does not."""
    return opaque(Scene.from_parts([ball(2, centre=(0.0, -0.6, 0.0), radius=0.3), bowl(8, 16)]))


@pytest.fixture(scope="module")
def scattering(surface):
    return PartScattering(surface.scene.part(0), MEDIUM)


@pytest.fixture(scope="module")
def direct(surface):
    rng = np.random.default_rng(7)
    return [
        rng.random((stop - start, 1, N_COEFFS)).astype(np.float32)
        for start, stop in surface.scene.part_ranges
    ]


def dense(scene, dipole):
    """S with every triangle integrated, (channels, verts, verts)."""
    n = scene.n_vertices
    rows, tris = np.divmod(np.arange(n * scene.n_faces), scene.n_faces)
    corners = scene.faces[tris]
    weights = hat_moments(dipole, scene.positions[rows], scene.positions[corners])
    found = np.zeros((dipole.n_channels, n, n))
    for channel, own in enumerate(found):
        np.add.at(own, (np.repeat(rows, 3), corners.ravel()), weights[channel].ravel())
    return dipole.entering_transmittance * found


def bounced(surface, direct, scattering, **changes):
    settings = {"max_bounces": 30, "tolerance": 0.0, "n_channels": 3} | changes
    return bounce_block(
        surface, direct, factorisations=[DIFFUSE] * 2, albedo=ALBEDO,
        n_rays=[N_RAYS] * 2, seed=SEED,
        scattering=scattering, **settings,
    )  # fmt: skip


def test_direct_light_alone_is_scattered_without_a_ray(surface, scattering, direct):
    found = bounced(surface, direct, [scattering, None], max_bounces=0)
    expected = np.einsum("cpq,qk->pck", dense(surface.scene.part(0), MEDIUM), direct[0][:, 0])
    total = expected.max()
    # clusters stand for transfer that differs from vertex to vertex at random: the worst there is
    np.testing.assert_allclose(found.added[0][:, :, 0], expected, atol=8e-3 * total)
    assert not found.added[1].any()
    assert found.counters == {}
    assert found.remainder_energy is None
    # negative twins: the channels of another order, and light that leaves where it falls
    assert np.abs(found.added[0][:, ::-1, 0] - expected).max() > 0.1 * total
    there = MEDIUM.diffuse_albedo[:, None] * direct[0]
    assert np.abs(there - expected).max() > 0.1 * total


def test_bounces_and_scattering_are_one_linear_system(surface, scattering, direct):
    """(1 - S G) T_out = S T for all vertices, G the sparse operator of bounces."""
    scene = surface.scene
    n, own = scene.n_vertices, scene.part_ranges[0][1]
    gathered = build_bounce_block(surface, (0, n), albedo=ALBEDO, n_rays=N_RAYS, seed=SEED)
    arriving = np.concatenate([one[:, 0] for one in direct]).astype(np.float64)
    found = bounced(surface, direct, [scattering, None], rounds=[0, 0])
    for channel, inside in enumerate(dense(scene.part(0), MEDIUM)):
        leaving = np.eye(n)
        leaving[:own, :own] = inside
        operator = np.eye(n) - leaving @ gathered.matrices[0].toarray()
        expected = np.linalg.solve(operator, leaving @ arriving)
        total = np.concatenate(
            [found.added[0][:, channel, 0], (found.added[1] + direct[1][:, None])[:, channel, 0]]
        )
        np.testing.assert_allclose(total, expected, atol=2e-3 * expected.max())
        # negative twin: bounces that miss the scattering of what arrives by them
        once = np.linalg.solve(
            np.eye(n) - gathered.matrices[0].toarray(),
            np.vstack([inside @ arriving[:own], arriving[own:]]),
        )
        assert np.abs(once - expected).max() > 0.05 * expected.max()


def test_what_is_left_out_is_bounded_with_scattering_too(surface, scattering, direct):
    media, areas = [scattering, None], surface.scene.areas
    full = bounced(surface, direct, media)
    for n in (1, 2, 4):
        cut = bounced(surface, direct, media, max_bounces=n)
        assert cut.is_bound
        for part, (start, stop) in enumerate(surface.scene.part_ranges):
            lacking = full.added[part].astype(np.float64) - cut.added[part]
            energy = float(areas[start:stop] @ (lacking**2).sum(axis=(1, 2, 3)))
            assert energy <= cut.remainder_energy[part] < 40.0 * energy


def test_the_noise_of_rays_is_no_larger_than_said(surface, scattering, direct):
    """Of the first bounce, over two seeds; scattering evens out what it gathers."""
    found = [
        bounce_block(
            surface, direct, factorisations=[DIFFUSE] * 2, albedo=ALBEDO, n_channels=3,
            n_rays=[16] * 2, seed=seed, max_bounces=1, tolerance=0.0, scattering=[scattering, None],
        )
        for seed in range(4)
    ]  # fmt: skip
    for part, (start, stop) in enumerate(surface.scene.part_ranges):
        every = np.stack([one.added[part] for one in found]).astype(np.float64)
        variance = every.var(axis=0, ddof=1).sum(axis=(1, 2, 3))
        true = float(surface.scene.areas[start:stop] @ variance)
        said = np.mean([one.noise_energy[part] for one in found])
        assert true < 1.3 * said
        if part == 0:
            # it is a bound there, and no tight one
            assert true < 0.7 * said


def test_rows_in_files_are_the_rows_in_memory(surface, scattering, direct, tmp_path, monkeypatch):
    monkeypatch.setattr(part_scattering, "KEPT_BYTES", 0)
    spilled = PartScattering(surface.scene.part(0), MEDIUM, scratch=tmp_path)
    # mapped in from a file, which has no name to be left behind
    assert not any(rows.values.flags.writeable for rows in spilled._rows)
    assert all(rows.values.flags.writeable for rows in scattering._rows)
    assert list(tmp_path.iterdir()) == []
    for part in (spilled, scattering):
        for rows, matrices in zip(part._rows, part._matrices, strict=True):
            assert all(np.shares_memory(one.data, rows.values) for one in matrices)
            assert all(np.shares_memory(one.indices, rows.columns) for one in matrices)
    arriving = np.repeat(direct[0][:, None], 3, axis=1)
    assert spilled.apply(arriving).tobytes() == scattering.apply(arriving).tobytes()
    assert spilled.report == scattering.report


def test_rows_that_were_built_before_serve_as_well(surface, scattering, direct):
    scene, steps = surface.scene.part(0), []
    operator = SubsurfaceOperator(scene, MEDIUM)
    rows = [
        build_rows(operator, start, stop, progress=lambda done, all_: steps.append((done, all_)))
        for start, stop in ((0, 60), (60, scene.n_vertices))
    ]
    assert steps == [(60, 60), (102, 102)]
    given = PartScattering(scene, MEDIUM, rows=iter(rows))
    arriving = np.repeat(direct[0][:, None], 3, axis=1)
    largest = np.abs(arriving).max()
    # the last bit of sums of float32
    np.testing.assert_allclose(
        given.apply(arriving), scattering.apply(arriving), atol=1e-6 * largest
    )
    assert given.report == scattering.report
    with pytest.raises(SettingsError, match="rows of 60 vertices for 162"):
        PartScattering(scene, MEDIUM, rows=rows[:1])
    with pytest.raises(SettingsError, match="rows of vertex 60 where those of 0 should be"):
        PartScattering(scene, MEDIUM, rows=rows[::-1])
    grey = Dipole(np.array([5.0]), np.array([0.5]), 1.3)
    with pytest.raises(SettingsError, match="0 to 60 are those of another operator"):
        PartScattering(scene, grey, rows=rows)


def test_one_channel_of_a_medium_serves_three(surface, direct):
    grey = PartScattering(surface.scene.part(0), Dipole(np.array([5.0]), np.array([0.5]), 1.3))
    one = grey.apply(direct[0][:, None])
    three = grey.apply(np.repeat(direct[0][:, None], 3, axis=1))
    np.testing.assert_array_equal(three, np.repeat(one, 3, axis=1))
    assert grey.albedo(3).tolist() == grey.dipole.diffuse_albedo.tolist() * 3


def test_the_measured_error_is_that_of_the_rows(surface, scattering, direct):
    transfer = direct[0][:, 0]
    said = np.mean([scattering.measured_error(transfer, seed=[1, block]) for block in range(4)])
    exact = np.einsum("cpq,qk->cpk", dense(surface.scene.part(0), MEDIUM), transfer)
    ours = scattering.apply(np.repeat(direct[0][:, None], 3, axis=1))[:, :, 0].transpose(1, 0, 2)
    true = float(((ours - exact) ** 2).sum() / (exact**2).sum())
    # a dozen vertices stand for all
    assert 0.2 * true < said < 5.0 * true
    assert 1e-9 < said < 1e-4
    # a row that was drawn three times counts three times, whatever its area
    operator, rows = scattering.operator, np.array([5, 40])
    once, thrice = (
        operator.measured_error(transfer, rows, np.array(counts))
        for counts in ((1.0, 1.0), (1.0, 3.0))
    )
    shares = [operator.measured_error(transfer, rows[[k]], np.ones(1)) for k in (0, 1)]
    assert min(shares) < min(once, thrice) <= max(once, thrice) < max(shares)
    assert abs(thrice - shares[1]) < abs(once - shares[1])


def test_what_cannot_be_scattered_is_refused(surface, scattering, direct):
    with pytest.raises(SettingsError, match="3 channels, the transfer 1"):
        scattering.apply(direct[0][:, None])
    with pytest.raises(SettingsError, match="one term, not 2"):
        scattering.apply(np.zeros((162, 3, 2, 4), np.float32))
    with pytest.raises(SettingsError, match="not be negative"):
        bounced(surface, direct, [scattering, None], max_bounces=-1)
