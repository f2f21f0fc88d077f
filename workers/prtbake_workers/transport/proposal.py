"""Directions in which a path goes on: a mixture of the cosine and a lobe about the mirror.

A BRDF here can be evaluated and nothing else, so the density that its paths are drawn from is
fitted to it: a share of half vectors by the distribution of Trowbridge and Reitz ("GGX"), the
rest by the cosine.  Any mixture with a cosine share is unbiased for any BRDF; the fit picks the one
whose estimates vary least.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import Brdf, is_isotropic
from prtbake_workers.transport.hemisphere_rays import cosine_directions, lattice

ROUGHNESSES = (0.02, 0.05, 0.1, 0.2, 0.35, 0.6)
LOBE_SHARES = (0.4, 0.8, 0.95)
"""Never 1: what lies outside the lobe is drawn by the cosine."""

VIEW_COSINES = (0.95, 0.7, 0.4, 0.15)
VIEW_AZIMUTHS = (0.0, 0.25 * np.pi, 0.5 * np.pi)
"""Of an anisotropic BRDF's views; the lobe of the mixture is isotropic, a compromise."""

FIT_SAMPLES = 256
"""Directions of each component that the variances are estimated from."""


@dataclass(frozen=True)
class Proposal:
    """A density of directions wi for a given wo, in the local frame.

    Attributes
    ----------
    lobe_share
        Probability of the lobe, in [0, 1).
    roughness
        Width of its half vectors, the alpha of Trowbridge and Reitz.
    """

    lobe_share: float = 0.0
    roughness: float = 1.0

    def sample(
        self,
        wo: Float64[F64, "paths 3"],
        choice: Float64[F64, " paths"],
        square: Float64[F64, "paths 2"],
    ) -> Float64[F64, "paths 3"]:
        """Draw directions from uniform numbers; those of the lobe may lie below the surface."""
        wi = cosine_directions(square)
        lobe = np.flatnonzero(choice < self.lobe_share)
        if len(lobe):
            half = self._half_vectors(square[lobe])
            along = (wo[lobe] * half).sum(axis=1, keepdims=True)
            wi[lobe] = 2.0 * along * half - wo[lobe]
        return wi

    def pdf(
        self, wi: Float64[F64, "paths 3"], wo: Float64[F64, "paths 3"]
    ) -> Float64[F64, " paths"]:
        """Give the density per sr; 0 below the surface, where nothing is reflected."""
        above = wi[:, 2] > 0.0
        density = (1.0 - self.lobe_share) * np.where(above, wi[:, 2], 0.0) / np.pi
        if self.lobe_share == 0.0:
            return density
        half = wi + wo
        length = np.linalg.norm(half, axis=1)
        length = np.where(length > 0.0, length, 1.0)
        cos_h = half[:, 2] / length
        # wo . h = |wi + wo| / 2
        lobe = self._half_density(cos_h) / (2.0 * length)
        return density + self.lobe_share * np.where(above, lobe, 0.0)

    def _half_vectors(self, square: Float64[F64, "paths 2"]) -> Float64[F64, "paths 3"]:
        a2 = self.roughness**2
        cos2 = (1.0 - square[:, 0]) / (1.0 + (a2 - 1.0) * square[:, 0])
        sine, azimuth = np.sqrt(1.0 - cos2), 2.0 * np.pi * square[:, 1]
        return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.sqrt(cos2)], axis=1)

    def _half_density(self, cos_h: Float64[F64, " paths"]) -> Float64[F64, " paths"]:
        """D(h) cos_h, the density of half vectors."""
        a2 = self.roughness**2
        spread = (a2 - 1.0) * cos_h**2 + 1.0
        return np.asarray(a2 * np.maximum(cos_h, 0.0) / (np.pi * spread**2))


def fit_proposal(brdf: Brdf) -> Proposal:
    """Choose the mixture with the least second moment of rho cos / pdf.

    Over a few views, each relative to the squared albedo, from a fixed set of directions that every
    candidate shares.
    """
    candidates = [Proposal()]
    candidates += [Proposal(*pair) for pair in product(LOBE_SHARES, ROUGHNESSES)]
    components = [Proposal()] + [Proposal(0.5, roughness) for roughness in ROUGHNESSES]
    square = lattice(FIT_SAMPLES)
    choice = (np.arange(FIT_SAMPLES) * np.sqrt(2.0)) % 1.0
    moments = np.zeros(len(candidates))
    azimuths = VIEW_AZIMUTHS[:1] if is_isotropic(brdf) else VIEW_AZIMUTHS
    for cosine, azimuth in product(VIEW_COSINES, azimuths):
        sine = np.sqrt(1.0 - cosine**2)
        view = np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
        wo = np.tile(view, (FIT_SAMPLES, 1))
        wi = np.concatenate([component.sample(wo, choice, square) for component in components])
        wi = wi[wi[:, 2] > 0.0]
        wo = np.tile(view, (len(wi), 1))
        drawn = np.mean([component.pdf(wi, wo) for component in components], axis=0)
        value = brdf.eval_brdf(wi, wo).mean(axis=1) * wi[:, 2]
        albedo = float((value / drawn).sum())
        if albedo > 0.0:
            moments += [
                float((value**2 / (candidate.pdf(wi, wo) * drawn)).sum()) / albedo**2
                for candidate in candidates
            ]
    return candidates[int(np.argmin(moments))]
