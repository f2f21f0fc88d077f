"""MERL's measured isotropic BRDFs (.binary): validation, invalid samples, symmetry."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import B8, F64, Bool, Float64
from prtbake_workers.brdf.half_difference_table import (
    HalfDifferenceTable,
    bins_above_horizon,
    filled_from_nearest,
)

SHAPE = (90, 90, 180)
"""Bins of theta_h, theta_d, and of phi_d over half a turn."""

SCALES = (1.0 / 1500.0, 1.15 / 1500.0, 1.66 / 1500.0)
"""What a stored number of each channel is multiplied by to give 1/sr."""

HEADER_BYTES = 12
FILE_BYTES = HEADER_BYTES + 3 * 8 * SHAPE[0] * SHAPE[1] * SHAPE[2]

MAX_VALUE = 1e9
"""Largest BRDF taken, in 1/sr: a mirror measured to 0.001 degrees stays below it."""

MAX_INVALID_SHARE = 0.5
"""Share of the bins above the horizon that may be invalid: beyond it there is no measurement."""


@dataclass(frozen=True)
class MerlReport:
    """What was found in a table and done to it.

    A bin is invalid where a channel is negative; those above the horizon were measured badly, those
    below it not at all.  All are filled with the nearest valid bin.  ``asymmetry`` is the norm of
    what was averaged away to make the table mirror-symmetric, relative to what is left.
    """

    n_samples: int
    n_invalid: int
    n_invalid_above_horizon: int
    n_above_horizon: int
    most_negative: float
    largest: float
    asymmetry: float

    def to_dict(self) -> dict[str, Any]:
        """Give plain values."""
        return asdict(self)


def is_merl(data: bytes) -> bool:
    """Tell whether the bytes begin with three small counts, as no other format here does."""
    if len(data) < HEADER_BYTES:
        return False
    counts = np.frombuffer(data[:HEADER_BYTES], "<i4")
    return bool((counts > 0).all() and (counts <= 4096).all())


def read_merl(data: bytes) -> tuple[HalfDifferenceTable, MerlReport]:
    """Read a table of 90 x 90 x 180 samples a channel [Matusik2003]_.

    The stored samples stand for the centres of their bins.  phi_d runs over half a turn, since
    exchanging light and view adds pi to it; the mirror image of phi_d, pi - phi_d, is averaged with
    it, as the transfer needs a symmetric BRDF, and the difference reported.

    Raises
    ------
    BrdfError
        Wrong counts or size, numbers that are not finite or beyond `MAX_VALUE`, or too few valid
        samples; the message says where.

    References
    ----------
    .. [Matusik2003] W. Matusik, H. Pfister, M. Brand, L. McMillan, "A Data-Driven Reflectance
       Model", 2003.
    """
    values = _decode(data)
    _check_numbers(values)
    invalid: B8 = np.any(values < 0.0, axis=0)
    above = _whole_turn(bins_above_horizon(SHAPE[0], SHAPE[1], SHAPE[2] // 2))
    n_bad, n_above = int((invalid & above).sum()), int(above.sum())
    if n_bad > MAX_INVALID_SHARE * n_above:
        raise BrdfError(
            f"{n_bad} of the {n_above} samples above the horizon are negative, that is invalid"
        )
    halves, valid, asymmetry = _symmetrised(values, ~invalid, above)
    filled = filled_from_nearest(halves, valid)
    report = MerlReport(
        n_samples=invalid.size,
        n_invalid=int(invalid.sum()),
        n_invalid_above_horizon=n_bad,
        n_above_horizon=n_above,
        most_negative=min(0.0, float(values.min())),
        largest=float(filled.max()),
        asymmetry=asymmetry,
    )
    table = np.ascontiguousarray(np.moveaxis(filled, 0, -1), dtype=np.float32)
    return HalfDifferenceTable(table), report


def _decode(data: bytes) -> Float64[F64, "3 theta_h theta_d phi_d"]:
    """Check header and size; scale to 1/sr."""
    if len(data) < HEADER_BYTES:
        raise BrdfError(f"the file ends after {len(data)} bytes, within the header of a MERL table")
    counts = tuple(int(n) for n in np.frombuffer(data[:HEADER_BYTES], "<i4"))
    if counts != SHAPE:
        raise BrdfError(
            f"the header promises {' x '.join(map(str, counts))} samples; a MERL table has "
            f"{' x '.join(map(str, SHAPE))} (theta_h, theta_d, phi_d)"
        )
    if len(data) != FILE_BYTES:
        n_plane = SHAPE[0] * SHAPE[1] * SHAPE[2]
        n_whole = (len(data) - HEADER_BYTES) // 8
        place = (
            f"it ends in channel {'RGB'[n_whole // n_plane]} at theta_h bin "
            f"{n_whole % n_plane // (SHAPE[1] * SHAPE[2])}"
            if n_whole < 3 * n_plane
            else "something follows the samples"
        )
        raise BrdfError(f"the file has {len(data)} bytes, a MERL table {FILE_BYTES}: {place}")
    stored = np.frombuffer(data, "<f8", offset=HEADER_BYTES).reshape(3, *SHAPE)
    values: F64 = stored * np.array(SCALES)[:, None, None, None]
    return values


def _check_numbers(values: Float64[F64, "3 theta_h theta_d phi_d"]) -> None:
    good = np.isfinite(values) & (values <= MAX_VALUE)
    if good.all():
        return
    channel, h, d, p = np.argwhere(~good)[0]
    raise BrdfError(
        f"{int((~good).sum())} samples are not finite or above {MAX_VALUE:g}, the first in channel "
        f"{'RGB'[channel]} at theta_h bin {h}, theta_d bin {d}, phi_d bin {p}: "
        f"{values[channel, h, d, p]:g}"
    )


def _whole_turn(half: Bool[B8, "theta_h theta_d half"]) -> Bool[B8, "theta_h theta_d phi_d"]:
    return np.concatenate([half, half[:, :, ::-1]], axis=2)


def _symmetrised(
    values: Float64[F64, "3 theta_h theta_d phi_d"],
    valid: Bool[B8, "theta_h theta_d phi_d"],
    above: Bool[B8, "theta_h theta_d phi_d"],
) -> tuple[Float64[F64, "3 theta_h theta_d half"], Bool[B8, "theta_h theta_d half"], float]:
    """Average phi_d with pi - phi_d, of the valid ones; tell where any was, and the asymmetry."""
    half = SHAPE[2] // 2
    one, other = values[..., :half], values[..., : half - 1 : -1]
    has_one, has_other = valid[..., :half], valid[..., : half - 1 : -1]
    n_valid = has_one.astype(np.int64) + has_other
    total = np.where(has_one, one, 0.0) + np.where(has_other, other, 0.0)
    mean = total / np.maximum(n_valid, 1)
    both = has_one & has_other & above[..., :half]
    away = 0.5 * np.linalg.norm((one - other)[:, both])
    kept = float(np.linalg.norm(mean[:, both]))
    return mean, n_valid > 0, float(away / kept) if kept > 0.0 else 0.0
