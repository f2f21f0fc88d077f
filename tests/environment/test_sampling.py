"""The sampler against its density, and the density against the sphere."""

import numpy as np
import pytest
from scipy import stats

from prtbake_workers.environment.environment import LUMINANCE, Environment, directions_from_angles
from prtbake_workers.environment.procedural import constant, one_texel_sun
from prtbake_workers.environment.sampling import EnvironmentSampler


@pytest.fixture
def uneven(rng) -> Environment:
    radiance = rng.random((12, 24, 3)) ** 4
    radiance[9:] = 0.0
    radiance[2, 7] = 5.0
    return Environment(radiance.astype(np.float32))


def chi_square_p(sampler: EnvironmentSampler, directions, pdf) -> float:
    """Compare counts with the integral of a density over bins that cut through the texels."""
    n_heights, n_turns, sub = 7, 13, 120

    def bin_of(d):
        height = np.minimum(((d[:, 1] + 1) / 2 * n_heights).astype(int), n_heights - 1)
        turn = np.floor((np.arctan2(d[:, 0], d[:, 2]) / (2 * np.pi) + 0.5) * n_turns).astype(int)
        return height * n_turns + np.clip(turn, 0, n_turns - 1)

    counts = np.bincount(bin_of(directions), minlength=n_heights * n_turns)
    y = (np.arange(n_heights * sub) + 0.5) / (n_heights * sub) * 2 - 1
    turns = (np.arange(n_turns * sub) + 0.5) / (n_turns * sub) * 2 * np.pi - np.pi
    fine = directions_from_angles(np.tile(turns, len(y)), np.repeat(y, len(turns)))
    mass = np.bincount(bin_of(fine), pdf(fine), n_heights * n_turns) * 4 * np.pi / len(fine)
    expected = mass / mass.sum() * len(directions)
    # bins below 5 are pooled
    small = expected < 5
    observed = np.append(counts[~small], counts[small].sum())
    expected = np.append(expected[~small], expected[small].sum())
    seen = expected > 0
    return float(stats.chisquare(observed[seen], expected[seen]).pvalue)


def test_samples_follow_the_density(uneven, rng) -> None:
    sampler = EnvironmentSampler(uneven)
    samples = sampler.sample(20_000, rng, stratified=False)
    assert chi_square_p(sampler, samples.directions, sampler.pdf) > 1e-3


def test_a_density_without_the_solid_angle_fails_the_same_test(uneven, rng) -> None:
    sampler = EnvironmentSampler(uneven)
    samples = sampler.sample(20_000, rng, stratified=False)

    def wrong(directions):
        return sampler.pdf(directions) / np.maximum(np.sqrt(1 - directions[:, 1] ** 2), 1e-3)

    assert chi_square_p(sampler, samples.directions, wrong) < 1e-6


def test_density_integrates_to_one_and_is_the_samples_own(uneven, rng) -> None:
    sampler = EnvironmentSampler(uneven)
    total = sampler.pdf(uneven.directions()) @ uneven.solid_angles()
    assert total == pytest.approx(1.0, rel=1e-12)
    samples = sampler.sample(5_000, rng)
    assert np.array_equal(sampler.pdf(samples.directions), samples.pdf)
    assert np.array_equal(uneven.lookup(samples.directions), samples.radiance)
    assert np.linalg.norm(samples.directions, axis=1) == pytest.approx(np.ones(5_000), rel=1e-12)


@pytest.mark.parametrize("stratified", [True, False])
def test_the_estimate_of_the_power_has_no_noise(uneven, rng, stratified) -> None:
    samples = EnvironmentSampler(uneven).sample(500, rng, stratified=stratified)
    estimate = (samples.radiance / samples.pdf[:, None]).mean(axis=0) @ LUMINANCE
    # luminance over density is the same for every sample: rounding alone
    assert estimate == pytest.approx(uneven.mean_radiance @ LUMINANCE * 4 * np.pi, rel=1e-12)


def test_strata_follow_a_cosine_better_than_chance(rng) -> None:
    sampler = EnvironmentSampler(constant(64))

    def spread(stratified):
        sums = []
        for _ in range(30):
            s = sampler.sample(400, rng, stratified=stratified)
            sums.append((np.maximum(s.directions[:, 1], 0) / s.pdf).mean())
        assert np.mean(sums) == pytest.approx(np.pi, rel=0.03)
        return np.std(sums)

    assert spread(stratified=True) < 0.3 * spread(stratified=False)


def test_a_black_environment_is_sampled_evenly(rng) -> None:
    sampler = EnvironmentSampler(constant(16, 0.0))
    samples = sampler.sample(4_000, rng)
    assert samples.pdf == pytest.approx(np.full(4_000, 1 / (4 * np.pi)), rel=1e-12)
    assert (samples.radiance == 0).all()
    assert np.abs(samples.directions.mean(axis=0)).max() < 0.02


def test_a_sun_of_one_texel_gets_its_share_and_no_black_texel_is_drawn(rng) -> None:
    sun = one_texel_sun(64, sun_irradiance=9.0, sky_radiance=1.0 / (4 * np.pi))
    samples = EnvironmentSampler(sun).sample(1_000, rng)
    assert ((samples.radiance[:, 0] > 10).sum() - 900) in (-1, 0, 1)
    radiance = np.zeros((8, 16, 3), dtype=np.float32)
    radiance[5, 3] = 1.0
    lone = EnvironmentSampler(Environment(radiance)).sample(1_000, rng)
    assert (lone.radiance == 1).all()


def test_the_same_seed_gives_the_same_bytes(uneven) -> None:
    draws = [EnvironmentSampler(uneven).sample(100, np.random.default_rng(7)) for _ in range(2)]
    assert draws[0].directions.tobytes() == draws[1].directions.tobytes()
