"""As many scattered SRBFs as a given error asks for, from coarse to fine."""

import time

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import SettingsError
from prtbake_workers.deadline import time_for
from prtbake_workers.environment.environment import Environment
from prtbake_workers.environment.fit.cells import FitSamples, fit_samples
from prtbake_workers.environment.fit.growth import grow
from prtbake_workers.environment.fit.objective import Lobes
from prtbake_workers.environment.fit.scattered import (
    Progress,
    ScatteredFit,
    fit_to_samples,
    no_progress,
    with_coefficients,
)

FIRST_LOBES = 12
"""Of the first, coarsest fit."""

FINE_ROWS = 15
"""Of parts of a bright texel: what lobes blur of a sun's edge goes by the width of a part, and is
6 % of a sun of one texel with 7 rows."""

LEAST_GROWTH, MOST_GROWTH = 1.1, 2.0
"""Of the number of lobes from one fit to the next."""


def fit_to_error(
    environment: Environment,
    max_error: float,
    *,
    most_lobes: int,
    seed: int,
    max_iterations: int = 6,
    progress: Progress | None = None,
) -> ScatteredFit:
    """Fit a map with few lobes that leave no more than a squared-error ratio.

    A fit of 12 lobes comes first.  Then the number grows, by as much as the errors so far predict
    the target to ask for and at most twofold; lobes are added to the last fit where that leaves
    most, and all settle.

    Parameters
    ----------
    environment
        Texels of one radiance each.
    max_error
        Squared-error ratio over the sphere, between 0 and 1, both excluded.
    most_lobes
        The most that may be taken, at least 1.
    seed, max_iterations, progress
        As of `fit_environment`.

    Returns
    -------
    ScatteredFit
        With an error of at most ``max_error``; ``errors`` tells what each number of lobes left.

    Raises
    ------
    SettingsError
        The target is not between 0 and 1, or ``most_lobes`` leave more, or a deadline ends the
        search: says what is left.
    """
    return fit_samples_to_error(
        fit_samples(environment, FINE_ROWS),
        max_error,
        most_lobes=most_lobes,
        seed=seed,
        max_iterations=max_iterations,
        progress=progress,
    )


def fit_samples_to_error(
    samples: FitSamples,
    max_error: float,
    *,
    most_lobes: int,
    seed: int,
    max_iterations: int = 6,
    progress: Progress | None = None,
) -> ScatteredFit:
    """Fit light that has been sampled; see `fit_to_error`."""
    if not 0.0 < max_error < 1.0:
        raise SettingsError(
            f"max_error is {max_error}: between 0 and 1, as no sum of lobes is exact",
            pointer="/settings/max_error",
        )
    report = progress or no_progress
    texels = samples.moving
    most = min(most_lobes, len(texels.solid_angles))
    first = min(FIRST_LOBES, most)
    fit = fit_to_samples(
        samples, first, seed, max_iterations, lambda share, name: report(0.1 * share, name)
    )
    trace = [(len(fit.bandwidths), fit.error)]
    best, done = fit, 0.1
    took = 0.0
    while fit.error > max_error:
        n = len(fit.bandwidths)
        began = time.monotonic()
        if not time_for(took):
            raise SettingsError(
                f"max_seconds ended the search for max_error {max_error:g}: "
                f"{len(best.bandwidths)} lobes leave {best.error:.3g} of the light (squared, "
                "relative)",
                pointer="/settings/max_seconds",
            )
        with threadpool_limits(limits=1, user_api="blas"):
            wanted = min(_next_count(trace, max_error), most)
            lobes = grow(texels, Lobes(*fit[:2]), wanted, max_steps=4 * max_iterations)
            if len(lobes.bandwidths) == n:
                raise SettingsError(
                    f"max_error {max_error:g} cannot be met: {len(best.bandwidths)} lobes, of at "
                    f"most {most_lobes}, leave {best.error:.3g} of the light (squared, relative)",
                    pointer="/settings/max_error",
                )
            fit = with_coefficients(lobes, samples, n_peak_lobes=fit.n_peak_lobes, errors={})
        took = max(took, time.monotonic() - began)
        trace.append((len(fit.bandwidths), fit.error))
        best = min(best, fit, key=lambda one: one.error)
        left = np.log(max(best.error / max_error, 1.0)) / np.log(trace[0][1] / max_error)
        done = max(done, 1.0 - 0.9 * float(left))
        report(done, "grow")
    report(1.0, "coefficients")
    return fit._replace(errors={f"{count} lobes": error for count, error in trace})


def _next_count(trace: list[tuple[int, float]], max_error: float) -> int:
    """Extrapolate error = c n^-p from the last two fits; p is 1 before there are two."""
    n, error = trace[-1]
    power = 1.0
    if len(trace) > 1:
        (n_before, before) = trace[-2]
        power = float(np.log(max(before / error, 1.01)) / np.log(n / n_before))
    growth = (error / max_error) ** (1.0 / np.clip(power, 0.5, 3.0))
    wanted = int(np.ceil(n * np.clip(growth, LEAST_GROWTH, MOST_GROWTH)))
    return max(wanted, n + 1)
