"""From scattered samples of an isotropic BRDF to a table, by radial basis functions."""

from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import RBFInterpolator
from threadpoolctl import threadpool_limits

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.brdf.half_difference import HalfDifference, half_difference
from prtbake_workers.brdf.half_difference_table import (
    HalfDifferenceTable,
    bin_angles,
    bins_above_horizon,
    filled_from_nearest,
)
from prtbake_workers.brdf.scattered_text import ScatteredSamples

SHAPE = (60, 60, 30)
"""Bins of the table: 1.5 degrees of theta_d, in which retro-reflectors peak."""

OFFSET = 1e-4
"""Added before the logarithm, in 1/sr: an albedo of 3e-4 is as good as black."""

MIN_SAMPLES = 20
MAX_GLOBAL = 3000
"""Samples up to which every one bears on every place; above it, the nearest `NEIGHBOURS` do."""

NEIGHBOURS = 40
FEW_LIGHTS = 5
N_FOLDS = 5
LOG_OFFSET = 1e-3
"""As `OFFSET`, for the logarithmic error: differences below it do not show."""


class _Merged(NamedTuple):
    """Different places, what was measured there, and the product of both cosines.

    ``owner`` gives the place of each sample.
    """

    places: Float64[F64, "n 3"]
    values: Float64[F64, "n 3"]
    weight: Float64[F64, " n"]
    owner: Int64[I64, " samples"]


def interpolate_scattered(
    samples: ScatteredSamples, *, seed: int = 0
) -> tuple[HalfDifferenceTable, dict[str, Any]]:
    """Tabulate the interpolant of scattered samples over half and difference angles.

    The logarithm of the BRDF is interpolated by linear radial basis functions (which hit every
    sample) over ``(r cos phi_d, r sin phi_d, 2 theta_d / pi)`` with ``r = sqrt(2 theta_h / pi)``
    and phi_d folded by both symmetries: highlights are round there, and so is the distance between
    two samples of the same highlight under different light.  The result is kept between the
    smallest and the largest sample.

    Returns
    -------
    HalfDifferenceTable
        Isotropic, reciprocal and mirror-symmetric.
    dict
        The samples' facts, and errors: ``held_out`` at every sample when a fifth of them, itself
        among them, is kept from the interpolant; ``at_samples`` of the table where all were used;
        ``asymmetry`` of averaging samples that the symmetries bring together.
        Each is relative L2 weighted with both cosines, which highlights decide, and the root mean
        square of the logarithm.

    Raises
    ------
    BrdfError
        Fewer than `MIN_SAMPLES` different samples.
    """
    merged = _merge(samples)
    if len(merged.places) < MIN_SAMPLES:
        raise BrdfError(
            f"{len(merged.places)} different samples are too few to interpolate: {MIN_SAMPLES} are "
            "needed"
        )
    angles = HalfDifference(*np.broadcast_arrays(*bin_angles(*SHAPE)))
    above = bins_above_horizon(*SHAPE)
    # the number of threads would change the last bits
    with threadpool_limits(limits=1, user_api="blas"):
        values_at = np.zeros((*SHAPE, 3))
        at = HalfDifference(*(angle[above] for angle in angles))
        values_at[above] = _interpolate(merged.places, merged.values, _place(at))
        held_out = _held_out(merged, seed)
    filled = np.moveaxis(filled_from_nearest(np.moveaxis(values_at, -1, 0), above), 0, -1)
    table = HalfDifferenceTable(np.ascontiguousarray(filled, dtype=np.float32))
    warnings = []
    if samples.facts["n_lights"] < FEW_LIGHTS:
        warnings.append(
            f"{samples.facts['n_lights']} angles of light were measured: between them and beyond "
            "them the BRDF is a guess"
        )
    report = samples.facts | {
        "n_merged": len(samples.values) - len(merged.values),
        "asymmetry": _errors(merged.values[merged.owner], samples.values, _weight(samples))[
            "relative_l2"
        ],
        "held_out": _errors(held_out, merged.values, merged.weight),
        "at_samples": _errors(
            table.eval_brdf(samples.wi, samples.wo), samples.values, _weight(samples)
        ),
        "warnings": warnings,
    }
    return table, report


def _place(angles: HalfDifference) -> Float64[F64, "n 3"]:
    """Coordinates in which samples are compared."""
    radius = np.sqrt(angles.theta_h / (0.5 * np.pi))
    return np.stack(
        [
            radius * np.cos(angles.phi_d),
            radius * np.sin(angles.phi_d),
            angles.theta_d / (0.5 * np.pi),
        ],
        axis=-1,
    )


def _weight(samples: ScatteredSamples) -> Float64[F64, " samples"]:
    weight: F64 = samples.wi[:, 2] * samples.wo[:, 2]
    return weight


def _merge(samples: ScatteredSamples) -> _Merged:
    """Average samples that the symmetries bring to the same place."""
    places = _place(half_difference(samples.wi, samples.wo)).round(6)
    unique, first, owner = np.unique(places, axis=0, return_index=True, return_inverse=True)
    total = np.zeros_like(unique)
    np.add.at(total, owner, samples.values)
    mean = total / np.bincount(owner)[:, None]
    return _Merged(unique, mean, _weight(samples)[first], owner.astype(np.int64))


def _interpolate(
    places: Float64[F64, "n 3"], values: Float64[F64, "n 3"], at: Float64[F64, "m 3"]
) -> Float64[F64, "m 3"]:
    logs = np.log(values + OFFSET)
    neighbours = None if len(places) <= MAX_GLOBAL else NEIGHBOURS
    found = RBFInterpolator(places, logs, kernel="linear", neighbors=neighbours)(at)
    kept: F64 = np.exp(np.clip(found, logs.min(axis=0), logs.max(axis=0)))
    return np.maximum(kept - OFFSET, 0.0)


def _held_out(merged: _Merged, seed: int) -> Float64[F64, "n 3"]:
    """Interpolate every fold from the others; mirror images of a sample are in its own fold."""
    fold = np.random.default_rng(seed).permutation(len(merged.values)) % N_FOLDS
    guess = np.zeros_like(merged.values)
    for number in range(N_FOLDS):
        out = fold == number
        guess[out] = _interpolate(merged.places[~out], merged.values[~out], merged.places[out])
    return guess


def _errors(
    values: Float64[F64, "n 3"], wanted: Float64[F64, "n 3"], weight: Float64[F64, " n"]
) -> dict[str, float]:
    off = float(np.linalg.norm((values - wanted) * weight[:, None]))
    norm = float(np.linalg.norm(wanted * weight[:, None]))
    logs = np.log(values + LOG_OFFSET) - np.log(wanted + LOG_OFFSET)
    return {
        "relative_l2": off / norm if norm > 0.0 else 0.0,
        "log_rms": float(np.sqrt(np.mean(logs * logs))),
    }
