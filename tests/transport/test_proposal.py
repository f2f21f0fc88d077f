"""The density that paths go on with: that samples follow it, and that the fit serves the BRDF."""

import numpy as np
import pytest

from prtbake_workers.brdf.cook_torrance import CookTorrance
from prtbake_workers.brdf.lambert import Lambert
from prtbake_workers.brdf.phong import Phong
from prtbake_workers.transport.proposal import Proposal, fit_proposal

PROPOSALS = [Proposal(), Proposal(0.4, 0.6), Proposal(0.8, 0.2), Proposal(0.95, 0.05)]


def view(cosine):
    return np.array([np.sqrt(1.0 - cosine**2) * 0.6, np.sqrt(1.0 - cosine**2) * 0.8, cosine])


def drawn(proposal, cosine, n, rng):
    wo = np.tile(view(cosine), (n, 1))
    return proposal.sample(wo, rng.random(n), rng.random((n, 2))), wo


@pytest.mark.parametrize("proposal", PROPOSALS, ids=str)
@pytest.mark.parametrize("cosine", [0.9, 0.3])
def test_samples_follow_the_density(rng, proposal, cosine):
    """The mean of g over the samples above the surface is the integral of g pdf, for a few g.

    The integral by importance sampling from the same density would prove nothing, so it is done on
    half vectors, where the density is smooth: a product rule in their height and azimuth.
    """
    n = 200_000
    wi, _ = drawn(proposal, cosine, n, rng)
    above = wi[:, 2] > 0.0
    grid, solid_angle = directions_about_mirror(view(cosine), proposal.roughness)
    density = proposal.pdf(grid, np.tile(view(cosine), (len(grid), 1)))
    for g in (
        lambda w: np.ones(len(w)),
        lambda w: w[:, 2],
        lambda w: w @ (view(cosine) * [-1, -1, 1]),
        lambda w: (w @ np.array([0.6, 0.0, 0.8])) ** 8,
    ):
        expected = float((g(grid) * density * solid_angle).sum())
        values = np.where(above, g(wi), 0.0)
        error = values.std() / np.sqrt(n)
        # the product rule is good to 1e-3
        assert values.mean() == pytest.approx(expected, abs=5.0 * error + 1e-3)


def directions_about_mirror(wo, roughness, n=600):
    """Directions over the hemisphere with solid angles, dense about the mirror of wo.

    A lat-long grid about the mirror direction with polar angle t = u^2 pi, so that a lobe of any
    width is met by many of its rings.
    """
    mirror = wo * [-1.0, -1.0, 1.0]
    side = np.cross(mirror, [0.3, 0.5, -0.8])
    side /= np.linalg.norm(side)
    up = np.cross(mirror, side)
    u = (np.arange(n) + 0.5) / n
    polar, azimuth = np.pi * u**2, 2.0 * np.pi * u
    weight = np.sin(polar) * 2.0 * np.pi * u / n * (2.0 * np.pi / n)
    directions = (
        np.cos(polar)[:, None, None] * mirror
        + (np.sin(polar)[:, None] * np.cos(azimuth))[..., None] * side
        + (np.sin(polar)[:, None] * np.sin(azimuth))[..., None] * up
    ).reshape(-1, 3)
    solid_angle = np.repeat(weight, n)
    keep = directions[:, 2] > 0.0
    return directions[keep], solid_angle[keep]


def test_density_never_vanishes_above_the_surface(rng):
    """Or the estimate of some BRDF would be biased."""
    wi = rng.normal(size=(1000, 3))
    wi[:, 2] = np.abs(wi[:, 2])
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    for proposal in PROPOSALS:
        wo = np.tile(view(0.2), (1000, 1))
        assert (proposal.pdf(wi, wo) >= 0.049 * wi[:, 2] / np.pi).all()
        assert not proposal.pdf(wi * [1, 1, -1], wo).any()


def relative_deviation(brdf, proposal, rng):
    """Of rho cos / pdf, over views."""
    ratios = []
    for cosine in (0.9, 0.5, 0.2):
        wi, wo = drawn(proposal, cosine, 20_000, rng)
        density = proposal.pdf(wi, wo)
        value = brdf.eval_brdf(wi, wo)[:, 0] * np.maximum(wi[:, 2], 0.0)
        weight = value / np.where(density > 0.0, density, 1.0)
        ratios.append(weight.std() / weight.mean())
    return np.mean(ratios)


def test_a_diffuse_surface_gets_the_cosine(rng):
    proposal = fit_proposal(Lambert(np.array([0.5, 0.2, 0.9])))
    assert proposal.lobe_share == 0.0
    assert relative_deviation(Lambert(np.array([0.5])), proposal, rng) < 1e-9


@pytest.mark.parametrize(
    "brdf",
    [
        Phong(np.array([0.0]), np.array([0.8]), 200.0),
        CookTorrance(np.array([0.1]), np.array([0.9]), 0.1, np.array([0.9])),
    ],
    ids=["phong", "cook-torrance"],
)
def test_a_sharp_lobe_gets_one(rng, brdf):
    proposal = fit_proposal(brdf)
    fitted = relative_deviation(brdf, proposal, rng)
    # 1.4 and 0.5 were measured; the negative twin, the cosine alone, varies by 9 to 11 times its mean
    assert relative_deviation(brdf, Proposal(), rng) > 5.0 * fitted
    assert fitted < 1.6


def test_black_surfaces_are_fitted_too():
    assert fit_proposal(Lambert(np.zeros(1))) == Proposal()
