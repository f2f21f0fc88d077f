"""Importance sampling of an environment by its luminance."""

from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.environment.environment import (
    Environment,
    directions_from_angles,
    texel_of,
)


class LightSamples(NamedTuple):
    """Directions towards the light, in random order, with radiance and density per sr.

    The mean over the samples of f(direction) radiance / pdf estimates the integral of f L.
    """

    directions: Float64[F64, "samples 3"]
    radiance: Float64[F64, "samples 3"]
    pdf: Float64[F64, " samples"]


class EnvironmentSampler:
    """Draws directions with density luminance / (integral of luminance), constant over a texel.

    A black environment is sampled uniformly, so that an estimator divides by no zero.
    """

    def __init__(self, environment: Environment) -> None:
        self._environment = environment
        solid_angles = environment.solid_angles()
        power = environment.luminance.ravel() * solid_angles
        total = float(power.sum())
        if total <= 0.0:
            power, total = solid_angles, float(solid_angles.sum())
        self._cumulative = np.cumsum(power) / total
        # the last texel with power ends at exactly 1, so that no draw lands on a black one after it
        self._cumulative[int(np.flatnonzero(power)[-1]) :] = 1.0
        self._density = power / (total * solid_angles)

    def sample(self, n: int, rng: np.random.Generator, *, stratified: bool = True) -> LightSamples:
        """Draw ``n`` directions.

        Parameters
        ----------
        n
            Number of samples, at least 1.
        rng
            Source of randomness; the same state gives the same samples.
        stratified
            One sample in each of n equal shares of the power, and a Latin pattern of the heights
            inside the texels; otherwise independent samples.
        """
        if stratified:
            order = rng.permutation(n)
            along = (order + rng.random(n)) / n
            across = (rng.permutation(n) + rng.random(n)) / n
        else:
            along, across = rng.random(n), rng.random(n)
        return self.place(along, across)

    def place(
        self, along: Float64[F64, " samples"], across: Float64[F64, " samples"]
    ) -> LightSamples:
        """Map points of the unit square to directions: share of the power, height in the texel."""
        texels = np.searchsorted(self._cumulative, along, side="right")
        texels = np.minimum(texels, len(self._cumulative) - 1)
        return LightSamples(
            directions=self._inside(texels, along, across),
            radiance=self._environment.radiance.reshape(-1, 3)[texels].astype(np.float64),
            pdf=self._density[texels],
        )

    def pdf(self, directions: Float64[F64, "dirs 3"]) -> Float64[F64, " dirs"]:
        """Give the density per sr with which the unit directions are drawn."""
        height, width = self._environment.height, self._environment.width
        return self._density[texel_of(directions, height, width)]

    def _inside(
        self,
        texels: Int64[I64, " samples"],
        along: Float64[F64, " samples"],
        across: Float64[F64, " samples"],
    ) -> Float64[F64, "samples 3"]:
        """Place samples in their texels, uniformly over the solid angle.

        What is left of the power's coordinate inside the texel gives the azimuth, so that the
        strata carry on into a texel that holds many of them, such as a sun.
        """
        height, width = self._environment.height, self._environment.width
        start = np.where(texels > 0, self._cumulative[texels - 1], 0.0)
        share = (along - start) / (self._cumulative[texels] - start)
        row, column = np.divmod(texels, width)
        top, bottom = np.cos(row / height * np.pi), np.cos((row + 1) / height * np.pi)
        # a hair inside the edges, or rounding would place the sample in the next texel
        share, across = (np.clip(s, 1e-9, 1.0 - 1e-9) for s in (share, across))
        azimuth = (column + share) * (2 * np.pi / width) - np.pi
        cos_polar = top + (bottom - top) * across
        return directions_from_angles(azimuth, cos_polar)
