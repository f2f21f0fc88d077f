"""Rounded factors: what an asset looks like after a round trip through int8 or int16.

A factor x is stored as q = round(x / s), a level.  One scale s serves one column of one cluster (or
one channel of one view column): singular values fall by orders of magnitude along the columns, and
a single scale would leave the last ones a handful of steps.  s keeps only nine bits of mantissa, so
that q s has at most 24 and is exact in float32: every reader gets the same bits.

The scales are the finest that a number of bits holds (`peak_scales`), or come from whoever allots
bits to columns by what their errors weigh.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import Asset, Part, Precision

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]

INT8_MAX, INT16_MAX = 127, 32767
OFFSET = 128
"""Added to levels in int16 where they leave room: the upper byte of small ones is then 0, whatever
their sign, and shuffle and gzip make nothing of it."""

NUMBERS_AT_A_TIME = 1 << 18
"""Of a factor that is read: 2 MB."""
SCALE_MANTISSA_BITS = 9
SMALLEST_SCALE = 2.0**-120
"""Below it q s would be denormal; factors that small are zero to every picture."""

SHARED_AXES: Mapping[str, tuple[int, ...]] = {
    "light_bases": (1,),
    "dual_bases": (2,),
    "means": (1,),
    "components": (2,),
    "view_texture": (0, 1),
}
"""Axes along which a factor shares its scale: one scale a cluster and column, or view column."""

Scales = Mapping[str, F32]
"""Name of every rounded factor of a part -> its scales: (clusters, R) of the weights, else of the
factor's shape but for 1 along its `SHARED_AXES`."""


@dataclass(frozen=True)
class Quantised:
    """An int16 array and its scale, of the same number of axes (1 where the scale is shared)."""

    values: I16
    scale: F32

    def dequantised(self) -> F32:
        """Return the float32 values that every reader sees."""
        return self.values.astype(np.float32) * self.scale


def quantise(array: F32, shared_axes: tuple[int, ...]) -> Quantised:
    """Quantise with one scale along ``shared_axes``; error at most half a scale an element."""
    peak = np.abs(array).max(axis=shared_axes, keepdims=True).astype(np.float64)
    scale = finest_scale(peak, INT16_MAX)
    return Quantised(levels(array, scale), scale)


def levels(array: F32, scale: F32) -> I16:
    """Round to multiples of ``scale``, which broadcasts; 0 where that is 0.

    Raises
    ------
    ValueError
        A number is too large for int16 at its scale.
    """
    rounded = np.rint(array / np.where(scale > 0, scale, 1.0)) * (scale > 0)
    largest = np.abs(rounded).max(initial=0.0)
    if not largest <= INT16_MAX:
        raise ValueError(f"a level of {largest:.0f} does not fit 16 bits: the scale is too fine")
    values: I16 = rounded.astype(np.int16)
    return values


def finest_scale(peak: F64, largest: int) -> F32:
    """Smallest scale of few mantissa bits that brings the peak to at most level ``largest``."""
    return _few_bits(peak / largest, np.ceil)


def scale_below(step: F64) -> F32:
    """Largest scale of few mantissa bits that is no larger than a finite step."""
    return _few_bits(step, np.floor)


def _few_bits(step: F64, to_whole: np.ufunc) -> F32:
    mantissa, exponent = np.frexp(step)
    steps = 2.0**SCALE_MANTISSA_BITS
    scale = np.ldexp(to_whole(mantissa * steps) / steps, exponent)
    return np.where(scale < SMALLEST_SCALE, 0.0, scale).astype(np.float32)


def rounded_factors(part: Part) -> Iterator[tuple[str, F32]]:
    """Name and array of everything that is rounded; the view basis is small and stays exact."""
    for name in ("weights", *SHARED_AXES):
        array = getattr(part, name)
        if array is not None and array.size:
            yield name, array


def factor_peaks(part: Part) -> dict[str, F64]:
    """Largest magnitude under each scale; shapes as in `Scales`."""
    peaks = {}
    for name, array in rounded_factors(part):
        if name == "weights":
            peaks[name] = np.zeros((part.n_clusters, array.shape[1]))
            np.maximum.at(peaks[name], part.labels, np.abs(array).astype(np.float64))
        else:
            peak = np.abs(array).max(axis=SHARED_AXES[name], keepdims=True)
            peaks[name] = peak.astype(np.float64)
    return peaks


def peak_scales(part: Part, bits: int) -> dict[str, F32]:
    """Scales with which the largest number of every column takes all of ``bits``, 2 to 16."""
    largest = 2 ** (bits - 1) - 1
    return {name: finest_scale(peak, largest) for name, peak in factor_peaks(part).items()}


def round_part(part: Part, scales: Scales) -> dict[str, I16]:
    """Levels of every rounded factor; ValueError names one whose scale is too fine or missing."""
    rounded = {}
    for name, array in rounded_factors(part):
        if name not in scales:
            raise ValueError(f"{part.name}: no scale for {name}")
        try:
            rounded[name] = levels(array, _spread(name, scales[name], part.labels))
        except ValueError as error:
            raise ValueError(f"{part.name}/{name}: {error}") from error
    return rounded


def dequantised(
    name: str, values: NDArray[np.integer], scale: F32, labels: I32, *, offset: int = 0
) -> F32:
    """Return the float32 factor of levels; ``scale`` as in `Scales`.

    ``offset`` is taken off integers of at most 16 bits first.  A block of rows at a time: beside
    levels and factor lies next to nothing.
    """
    factor = np.empty(values.shape, np.float32)
    step = max(1, NUMBERS_AT_A_TIME // max(1, values[:1].size))
    for start in range(0, len(values), step):
        rows = slice(start, start + step)
        if name == "weights":
            own = scale[labels[rows]]
        else:
            own = scale[rows] if len(scale) == len(values) else scale
        # exact: whole numbers of 17 bits at the most
        levelled = values[rows].astype(np.float32) - np.float32(offset)
        np.multiply(levelled, own, out=factor[rows])
    return factor


def _spread(name: str, scale: F32, labels: I32) -> F32:
    """Give every row of the weights the scales of its cluster; those of others broadcast."""
    return scale[labels] if name == "weights" else scale


def stored_levels(values: I16) -> tuple[NDArray[np.int8] | I16, int]:
    """Give levels in the smallest type, as files hold them, and the offset that is added."""
    peak = int(np.abs(values.astype(np.int32)).max(initial=0))
    if peak <= INT8_MAX:
        return values.astype(np.int8), 0
    offset = OFFSET if peak <= INT16_MAX - OFFSET else 0
    return values + np.int16(offset), offset


def bits_of(values: NDArray[np.integer], *, offset: int = 0) -> int:
    """Bits that the largest level takes with its sign: 16 for 32767, 8 for 127, 1 for zeros.

    Levels are the values less ``offset``.
    """
    if values.size == 0:
        return 1
    largest = max(int(values.max()) - offset, offset - int(values.min()))
    return largest.bit_length() + 1


def quantise_asset(
    asset: Asset, bits: int | Sequence[Scales], errors: Sequence[float] | None = None
) -> Asset:
    """Return the asset that a reader will see when it is stored with ``bits``.

    Parameters
    ----------
    asset
        Float32 factors.
    bits
        16 or 8 for every factor, 32 for the asset itself, or the scales of each part.
    errors
        What rounding adds to each part, where it was measured: kept in its ``precision``.

    Returns
    -------
    Asset
        Normals, frames (both always in 16 bits) and all large factors rounded.  Render both to see
        what that costs.

    Raises
    ------
    ValueError
        For other bits, scales that do not fit, or frames that do not stand on the asset's normals.
    """
    if isinstance(bits, int) and bits == 32:
        held = [part for part in asset.parts if part.precision is not None]
        parts = tuple(replace(part, precision=None) for part in asset.parts)
        return replace(asset, parts=parts) if held else asset
    normals = unpack_units(pack_units(asset.normals))
    stated: Sequence[float | None] = [None] * len(asset.parts) if errors is None else errors
    parts = tuple(
        _quantise_part(part, scales, asset.normals, normals, error)
        for part, scales, error in zip(asset.parts, asset_scales(asset, bits), stated, strict=True)
    )
    return replace(asset, normals=normals, parts=parts)


def asset_scales(asset: Asset, bits: int | Sequence[Scales]) -> Sequence[Scales]:
    """Return the scales of each part; ValueError for bits other than 8 and 16."""
    if not isinstance(bits, int):
        return bits
    if bits not in (8, 16):
        raise ValueError(f"bits is {bits}, not 8, 16 or 32")
    return [peak_scales(part, bits) for part in asset.parts]


def _quantise_part(
    part: Part, scales: Scales, exact_normals: F32, normals: F32, error: float | None
) -> Part:
    rounded = round_part(part, scales)
    new: dict[str, Any] = {
        name: dequantised(name, values, scales[name], part.labels)
        for name, values in rounded.items()
    }
    bits = {name: bits_of(values) for name, values in rounded.items()}
    new["precision"] = Precision(bits=bits, error=error)
    if part.frames is not None:
        where = slice(*part.vertex_range)
        tangents = pack_tangents(part.name, part.frames, exact_normals[where])
        new["frames"] = unpack_frames(tangents, normals[where])
    return replace(part, **new)


def pack_units(vectors: F32) -> I16:
    """Round unit vectors (n, 3) to int16; the direction moves by at most 2.7e-5 rad."""
    return np.rint(vectors.astype(np.float64) * INT16_MAX).astype(np.int16)


def unpack_units(packed: I16) -> F32:
    """Return unit vectors."""
    vectors = packed.astype(np.float64)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    units: F32 = (vectors / np.maximum(length, 1.0)).astype(np.float32)
    return units


def pack_tangents(name: str, frames: F32, normals: F32) -> I16:
    """Keep the tangent of right-handed frames: normal and tangent give the rest."""
    handed = np.einsum("vi,vi->v", np.cross(frames[:, 2], frames[:, 0]), frames[:, 1])
    off = np.abs(frames[:, 2] - normals).max(axis=1)
    bad = np.flatnonzero((handed < 0.999) | (off > 1e-3))
    if bad.size:
        raise ValueError(
            f"frames of part {name!r}: vertex {bad[0]} is not right-handed about its normal"
        )
    return pack_units(frames[:, 0])


def unpack_frames(tangents: I16, normals: F32) -> F32:
    """Rebuild (verts, 3, 3) frames: tangent made orthogonal to the normal, bitangent = n x t."""
    normal = normals.astype(np.float64)
    tangent = tangents.astype(np.float64) / INT16_MAX
    tangent -= normal * np.einsum("vi,vi->v", tangent, normal)[:, None]
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    frames = np.stack([tangent, np.cross(normal, tangent), normal], axis=1)
    return frames.astype(np.float32)
