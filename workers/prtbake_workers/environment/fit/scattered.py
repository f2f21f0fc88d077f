"""The scattered SRBF fit: peaks apart, coarse to fine, all together at the end."""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import EnvironmentMapError, SettingsError
from prtbake_workers.arrays import F64, Float, Float64
from prtbake_workers.deadline import keep_time, time_for
from prtbake_workers.environment.environment import LUMINANCE, Environment
from prtbake_workers.environment.fit.cells import (
    Cells,
    FitSamples,
    adaptive_cells,
    even_cells,
    fit_samples,
)
from prtbake_workers.environment.fit.guess import guess_lobes
from prtbake_workers.environment.fit.objective import (
    Lobes,
    SquaredError,
    solve_over,
    squared_error,
)
from prtbake_workers.environment.fit.peaks import fit_peaks, split_peaks
from prtbake_workers.environment.fit.pursuit import reseed
from prtbake_workers.environment.fit.refine import refine

Progress = Callable[[float, str], None]

PEAK_SHARE = 3
"""At most one lobe in so many goes to suns and lamps."""

REGION_WEIGHT = 100.0
"""Weight of the regions' means in the last coefficients where there are peaks.

Beside a sun 1e5 times as bright as the sky, plain least squares uses lobes that span the sky to
mend the shape of the sun.  Measured on a sun of one texel with 24 lobes: the sky 13 % off with
weight 0 and 5 % with 100, the squared error 0.096 and 0.100.  On a real sun with 162 lobes the
squared error changes in the third digit.
"""

_ENOUGH_GAIN = 0.01
"""Relative gain of a round below which the rounds on one level end."""


class ScatteredFit(NamedTuple):
    """L(w) ~ sum_j coefficients_j exp(bandwidths_j (w . centres_j - 1)), eq. (21) of [Tsai2006]_.

    ``coefficients`` (R, G, B) may be negative, and so may the sum: the fit is the best in squared
    radiance, not a light that could exist.  ``error`` is the squared error over the squared
    radiance, both integrated over the sphere and summed over the channels; ``power_ratio`` the
    luminance that the lobes send out in all over that of the light; ``n_peak_lobes`` how many
    lobes began on suns and lamps; ``errors`` the error after each stage, on that stage's cells.
    """

    centres: Float64[F64, "lobes 3"]
    bandwidths: Float64[F64, " lobes"]
    coefficients: Float64[F64, "lobes 3"]
    error: float
    power_ratio: float
    n_peak_lobes: int
    errors: dict[str, float]


def fit_environment(
    environment: Environment,
    n_lobes: int,
    *,
    seed: int,
    max_iterations: int = 6,
    progress: Progress | None = None,
) -> ScatteredFit:
    """Fit a map that is constant over its texels, the bright ones split for the quadrature.

    See ``fit_scattered_srbf`` for the parameters.
    """
    samples = fit_samples(environment)
    return fit_to_samples(samples, n_lobes, seed, max_iterations, progress or no_progress)


def fit_scattered_srbf(
    radiance: Float[np.ndarray, "texels 3"],
    directions: Float[np.ndarray, "texels 3"],
    solid_angles: Float[np.ndarray, " texels"],
    n_lobes: int,
    *,
    seed: int,
    max_iterations: int = 6,
    progress: Progress | None = None,
) -> ScatteredFit:
    """Fit scattered Gaussian SRBFs to samples of the light, minimising eq. (20) of [Tsai2006]_.

    Peaks (suns, lamps) are taken off and get lobes of their own, seeded at the largest residuals.
    The rest follows section 5.3: first guess by coverage and a priority queue; L-BFGS-B on the
    centres, then on the bandwidths, in rounds; the lobes that matter least seeded anew; then finer
    cells with both free; the coefficients are solved (RLS) at every evaluation, and at the end with
    the error on the samples as they were given.

    Parameters
    ----------
    radiance, directions, solid_angles
        Samples of the light; directions are unit vectors, solid angles in sr sum to about 4 pi.
        Where the light is a sun of a few texels the samples should be about as dense in every
        direction; ``fit_environment`` splits texels to that end, and takes the error between the
        samples that lobes were fitted to.
    n_lobes
        Number of lobes, at least 1; where there are fewer samples, there are as few lobes.  Time
        grows with its square.
    seed
        Breaks ties of the first guess; equal arguments give equal results.
    max_iterations
        Rounds of centres and bandwidths on the coarsest level, at least 1; each finer pass takes
        at most 8 times as many steps.
    progress
        Called with the share done and the stage's name.

    Raises
    ------
    SettingsError
        If ``n_lobes`` or ``max_iterations`` is below 1.
    EnvironmentMapError
        If a sample is not finite or negative, or a solid angle is not positive; names it.
    """
    texels = Cells(*(np.asarray(a, dtype=np.float64) for a in (directions, radiance, solid_angles)))
    samples = FitSamples(texels, texels, texels)
    return fit_to_samples(samples, n_lobes, seed, max_iterations, progress or no_progress)


def fit_to_samples(
    samples: FitSamples, n_lobes: int, seed: int, max_iterations: int, progress: Progress
) -> ScatteredFit:
    """Fit light that has been sampled; see `fit_scattered_srbf` for the rest."""
    _check(samples.moving, n_lobes, max_iterations)
    # one BLAS thread: the bytes do not depend on the machine's cores, and the many small products
    # lose more to waiting threads than they gain
    with threadpool_limits(limits=1, user_api="blas"):
        return _fit_stages(samples, n_lobes, seed, max_iterations, progress)


def _fit_stages(
    samples: FitSamples, n_lobes: int, seed: int, max_iterations: int, progress: Progress
) -> ScatteredFit:
    """Go through the stages."""
    texels = samples.moving
    rng = np.random.default_rng(seed)
    n_lobes = min(n_lobes, len(texels.solid_angles))
    if texels.energy == 0.0:
        lobes = guess_lobes(even_cells(texels, face_cells(n_lobes, 3)), n_lobes, rng)
        return ScatteredFit(*lobes, np.zeros_like(lobes.centres), 0.0, 1.0, 0, {})
    errors: dict[str, float] = {}
    progress(0.0, "peaks")
    base, peaks = texels, Lobes(np.zeros((0, 3)), np.zeros(0))
    if n_lobes >= PEAK_SHARE:
        clipped, excess = split_peaks(texels)
        peaks = fit_peaks(excess, _power(texels), n_lobes // PEAK_SHARE)
        if len(peaks.bandwidths):
            base = clipped
    progress(0.1, "coarse")
    n_base = n_lobes - len(peaks.bandwidths)
    lobes = guess_lobes(even_cells(base, face_cells(n_base, 3)), n_base, rng)
    coarse = even_cells(base, face_cells(n_base, 9))
    began = time.monotonic()
    SquaredError(coarse).project(lobes)
    per_cell = (time.monotonic() - began) / len(coarse.solid_angles)
    # coefficients are solved and judged at all samples: up to 1.5 of what a projection there takes
    rows = len(samples.solving.solid_angles) + len(samples.judging.solid_angles)
    keep_time(1.5 * per_cell * rows)
    lobes = _rounds(coarse, lobes, max_iterations, errors)
    steps = 8 * max_iterations
    n_cells = face_cells(n_base, 32)
    progress(0.2, "fine")
    fine = even_cells(base, n_cells)
    if time_for(3.0 * per_cell * len(fine.solid_angles)):
        lobes = _pass(fine, lobes, steps, "fine", errors)
    progress(0.4, "joint")
    cells = adaptive_cells(base, n_cells, 96 * n_base + 4096)
    if time_for(3.0 * per_cell * len(cells.solid_angles)):
        lobes = _pass(cells, lobes, steps, "joint", errors)
    progress(0.8, "coefficients")
    if len(peaks.bandwidths):
        lobes = Lobes(*(np.concatenate(parts) for parts in zip(lobes, peaks, strict=True)))
    fit = with_coefficients(lobes, samples, n_peak_lobes=len(peaks.bandwidths), errors=errors)
    progress(1.0, "coefficients")
    return fit


def with_coefficients(
    lobes: Lobes, samples: FitSamples, *, n_peak_lobes: int, errors: dict[str, float]
) -> ScatteredFit:
    """Solve the coefficients of given lobes, and measure what they leave."""
    weight = REGION_WEIGHT if n_peak_lobes else 0.0
    coefficients = solve_over(lobes, samples.solving, region_weight=weight)
    judging = samples.judging
    return ScatteredFit(
        centres=lobes.centres,
        bandwidths=lobes.bandwidths,
        coefficients=coefficients,
        error=squared_error(lobes, coefficients, judging) / judging.energy,
        power_ratio=_lobe_power(lobes, coefficients) / _power(judging),
        n_peak_lobes=n_peak_lobes,
        errors=errors,
    )


def _rounds(cells: Cells, lobes: Lobes, max_rounds: int, errors: dict[str, float]) -> Lobes:
    """Move centres, then bandwidths, until a round gains little: steps 1 to 3 of section 5.3."""
    objective = SquaredError(cells)
    error = objective.project(lobes).error
    errors["guess"] = error / cells.energy
    for _ in range(max_rounds):
        if not time_for(0.0):
            break
        lobes = refine(objective, lobes, free="centres", max_steps=10)
        lobes = refine(objective, lobes, free="bandwidths", max_steps=10)
        before, error = error, objective.project(lobes).error
        if before - error < _ENOUGH_GAIN * before:
            break
    lobes = reseed(objective, lobes)
    errors["coarse"] = objective.project(lobes).error / cells.energy
    return lobes


def _pass(cells: Cells, lobes: Lobes, steps: int, name: str, errors: dict[str, float]) -> Lobes:
    """Move centres and bandwidths together: step 4 of section 5.3, on each level."""
    objective = SquaredError(cells)
    lobes = refine(objective, lobes, free="both", max_steps=steps)
    errors[name] = objective.project(lobes).error / cells.energy
    return lobes


def face_cells(n_lobes: int, cells_per_lobe: int) -> int:
    """Choose the cells along a cube's edge for so many cells a lobe, between 8 and 96."""
    return int(np.clip(round(np.sqrt(n_lobes * cells_per_lobe / 6)), 8, 96))


def _power(texels: Cells) -> float:
    """Integrate the luminance over the sphere."""
    return float(texels.solid_angles @ (texels.radiance @ LUMINANCE))


def _lobe_power(lobes: Lobes, coefficients: Float64[F64, "lobes 3"]) -> float:
    """Sum the lobes' integrals, 2 pi (1 - exp(-2 lam)) / lam each."""
    integrals = -2 * np.pi * np.expm1(-2 * lobes.bandwidths) / lobes.bandwidths
    return float(integrals @ (coefficients @ LUMINANCE))


def _check(texels: Cells, n_lobes: int, max_iterations: int) -> None:
    if n_lobes < 1:
        raise SettingsError(f"n_lobes is {n_lobes}: at least 1", pointer="/settings/n_lobes")
    if max_iterations < 1:
        raise SettingsError(
            f"max_iterations is {max_iterations}: at least 1", pointer="/settings/max_iterations"
        )
    bad = ~(np.isfinite(texels.radiance) & (texels.radiance >= 0)).all(axis=1)
    bad |= ~(texels.solid_angles > 0)
    if bad.any():
        i = int(np.argmax(bad))
        raise EnvironmentMapError(
            f"texel {i} has radiance {texels.radiance[i].tolist()} and solid angle "
            f"{texels.solid_angles[i]}: finite, not negative and positive are needed"
        )


def no_progress(_share: float, _stage: str) -> None:
    """Report to nobody."""
