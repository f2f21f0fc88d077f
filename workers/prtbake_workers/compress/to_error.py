"""Compress to an error that is asked for: find sizes that do, then leave out what they have over.

Sizes are searched with few iterations, along one scale: the error of a compression falls about as a
power of it.  Sizes that come out below the target are fitted in full, and what they are below it is
given back in columns (`prtbake_workers.compress.trim`), so that the error ends just under the
target whatever the search's steps were.
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import exp, log

import numpy as np

from prtbake_storage.contract.settings import MOST_CLUSTERS
from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.inputs import checked_vertex_weights
from prtbake_workers.compress.methods import Compressed, Fit, Sizes, compress, factors_of
from prtbake_workers.compress.pca import Principal
from prtbake_workers.compress.rows import Rows
from prtbake_workers.compress.trim import trimmed
from prtbake_workers.compress.view_basis import view_energies
from prtbake_workers.deadline import time_for

MOST_TRIALS = 10
"""Fits that look for sizes; a target that they do not meet is refused."""

TRIAL_ITERATIONS = 2
"""Of a trial's clustering: later ones win some per cent of the error."""

VIEW_SHARE = 0.15
"""Of the target, that the view basis of a tensor may leave."""

AIM = 0.75
"""Of the target, at which a trial aims where columns can be left out afterwards."""

NARROW_AIM = 0.95
"""Of the target, at which it aims where they cannot."""

ENOUGH = (0.5, 0.9)
"""Shares of the target between which a trial ends the search, where columns can be left out."""

NARROWLY_ENOUGH = (0.9, 1.0)
"""The same where they cannot."""

FALL = 2.0
"""Power of the scale by which errors fall, until two trials tell."""

STEEPEST, FLATTEST = 8.0, 0.25
"""Between which a measured power is believed."""

LARGEST_STEP = 4.0
"""Of the scale, up or down, from one trial to the next."""

MARGIN = 1e-5
"""Of the target, kept for rounding: errors are sums of float32 energies."""


@dataclass(frozen=True)
class Scaled:
    """Sizes of one trial, as `Sizes` has them."""

    n_clusters: int
    ranks: tuple[int, int, int]
    n_components: int


def compress_to_error(
    method: str,
    coefficients: Rows,
    sizes: Sizes,
    fit: Fit,
    target: float,
    *,
    kept: float = 0.0,
) -> Compressed:
    """Compress the transfer of one part to a squared-error ratio just below a target.

    Parameters
    ----------
    method, coefficients, fit
        As `prtbake_workers.compress.methods.compress` takes them.
    sizes
        To start from.  Clustered methods keep their clusters and scale their ranks or components;
        vector quantisation scales its clusters.
    target
        Squared-error ratio, weighted, in (0, 1).
    kept
        Share of the target, in [0, 1), that is kept for errors of others.

    Returns
    -------
    Compressed
        At most at the target less what is kept.  Vector quantisation, whose clusters are few and
        whole, ends near it; the others end within a column of it.

    Raises
    ------
    SettingsError
        The target is out of range, or no sizes that were tried meet it, or none before a deadline;
        the message tells the best.
    """
    if not 0.0 < target < 1.0:
        raise SettingsError(
            f"an error of {target} cannot be aimed at: it lies above 0 and below 1",
            pointer="/max_error",
        )
    asked, target = target, (1.0 - kept) * target
    start = replace(
        Scaled(sizes.n_clusters, sizes.ranks, sizes.n_components),
        ranks=_view_first(coefficients, sizes.ranks, fit, target)
        if method == "cta"
        else sizes.ranks,
    )
    lowest, highest = NARROWLY_ENOUGH if method == "vq" else ENOUGH
    trial = fit
    if method != "vq":  # a trial of vector quantisation is as quick with all of its iterations
        trial = replace(fit, max_iterations=min(fit.max_iterations, TRIAL_ITERATIONS))
    if method == "pca":
        signal = coefficients[:].reshape(len(coefficients), -1)
        trial = fit = replace(fit, principal=Principal(signal, fit.vertex_weights))
    ratios: list[float] = []
    held: tuple[Scaled, Compressed] | None = None
    took, in_time = 0.0, True
    for scaled in _search(method, start, coefficients.shape, target, ratios):
        in_time = not ratios or time_for(took)
        if not in_time:
            break
        began = time.monotonic()
        found = compress(method, coefficients, scaled, trial)
        took = max(took, time.monotonic() - began)
        ratio = found.model.squared_error_ratio
        ratios.append(ratio)
        if ratio <= target and (held is None or ratio > held[1].model.squared_error_ratio):
            held = scaled, found
        if lowest * target <= ratio <= highest * target:
            break
    if held is None and not in_time:
        raise SettingsError(
            f"max_seconds ended the search for a squared error of {asked:.3g}: the best of "
            f"{len(ratios)} trials of {method} leaves {min(ratios):.3g}",
            pointer="/max_seconds",
        )
    if held is None:
        raise SettingsError(
            f"a squared error of {asked:.3g} cannot be met by {method}: the best of {len(ratios)} "
            f"trials leaves {min(ratios):.3g}; take another method, more clusters or a larger "
            "error",
            pointer="/max_error",
        )
    scaled, met = held
    if method == "vq":
        return met
    if method != "pca" and time_for(took):  # PCA has no iterations to make more of
        full = compress(method, coefficients, scaled, fit)
        # more iterations win by their own measure, which need not be that of what is asked for
        if full.model.squared_error_ratio <= target:
            met = full
    weights = checked_vertex_weights(fit.vertex_weights, len(coefficients))
    model = trimmed(met.model, target * (1.0 - MARGIN), weights)
    return Compressed(model=model, factors=factors_of(model, coefficients.shape, fit.n_channels))


def _view_first(
    coefficients: Rows, ranks: tuple[int, int, int], fit: Fit, target: float
) -> tuple[int, int, int]:
    """Choose the view rank by what it leaves; the others start from the ladder's."""
    weights = checked_vertex_weights(fit.vertex_weights, len(coefficients))
    energies = view_energies(coefficients, weights, fit.n_channels)
    left = energies.sum() - np.cumsum(energies)
    view = int(np.argmax(left <= VIEW_SHARE * target * energies.sum())) + 1
    return view, ranks[1], ranks[2]


def _search(
    method: str,
    start: Scaled,
    shape: tuple[int, ...],
    target: float,
    ratios: list[float],
) -> Iterator[Scaled]:
    """Yield sizes to try, each by the errors of those before; end where no others are left."""
    aim = target * (NARROW_AIM if method == "vq" else AIM)
    scale, seen = 1.0, set[Scaled]()
    points: list[tuple[float, float]] = []
    for _ in range(MOST_TRIALS):
        sizes = _at(scale, start, method, shape)
        if sizes in seen:
            return
        seen.add(sizes)
        yield sizes
        points.append((log(scale), log(max(ratios[-1], 1e-300))))
        scale = exp(_next(points, log(aim)))


def _next(points: list[tuple[float, float]], aim: float) -> float:
    """Return the logarithm of the next scale: between bracketing trials, else along the power."""
    under = [point for point in points if point[1] <= aim]
    over = [point for point in points if point[1] > aim]
    at, error = points[-1]
    if under and over:
        (a, above), (b, below) = max(over), min(under)
        if a < b:
            # bisection where the chord would stay at one end: errors fall in steps of whole ranks
            share = min(0.8, max(0.2, (above - aim) / max(above - below, 1e-12)))
            return a + share * (b - a)
    power = FALL
    if len(points) > 1:
        (x, y), (u, v) = points[-2:]
        if u != x:
            power = min(STEEPEST, max(FLATTEST, -(v - y) / (u - x)))
    step = (error - aim) / power
    most = log(LARGEST_STEP)
    return at + min(most, max(-most, step))


def _at(scale: float, start: Scaled, method: str, shape: tuple[int, ...]) -> Scaled:
    """Scale what the method has, as far as its factors are fewer numbers than the transfer."""
    n_verts, n_rows, n_coeffs = shape
    dims, clusters = n_rows * n_coeffs, start.n_clusters

    def of(size: int, most: int) -> int:
        return max(1, min(most, round(size * scale)))

    if method == "vq":
        return replace(start, n_clusters=of(clusters, min(n_verts, MOST_CLUSTERS)))
    if method == "cta":
        view, light, vert = start.ranks
        own = clusters * n_coeffs * light + (clusters * n_rows * light * scale + n_verts) * vert
        scale = min(scale, n_verts * dims / max(own, 1))
        return replace(start, ranks=(view, of(light, n_coeffs), of(vert, min(n_verts, dims))))
    if method == "pca":
        clusters = 1
    most = (n_verts - clusters) * dims // (clusters * dims + n_verts)
    return replace(start, n_components=of(start.n_components, min(n_verts, dims, max(1, most))))
