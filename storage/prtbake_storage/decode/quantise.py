"""Sixteen-bit factors: what an asset looks like after a round trip through int16.

A factor x is stored as q = round(x / s) with |q| <= 32767.  One scale s serves one column of one
cluster (or one channel of one view column): singular values fall by orders of magnitude along the
columns, and a single scale would leave the last ones a handful of steps.  s keeps only nine bits
of mantissa, so that q s has at most 24 and is exact in float32: every reader gets the same bits.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.asset import Asset, Part

F32 = NDArray[np.float32]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]

INT16_MAX = 32767
SCALE_MANTISSA_BITS = 9
SMALLEST_SCALE = 2.0**-120
"""Below it q s would be denormal; factors that small are zero to every picture."""


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
    scale = _scale(peak)
    values = np.rint(array / np.where(scale > 0, scale, 1.0)).astype(np.int16)
    return Quantised(values, scale)


def quantise_weights(weights: F32, labels: I32, n_clusters: int) -> tuple[I16, F32]:
    """Quantise (verts, R) weights with one scale a cluster and column.

    Returns the int16 values and the (clusters, R) scales.
    """
    peak = np.zeros((n_clusters, weights.shape[1]))
    np.maximum.at(peak, labels, np.abs(weights).astype(np.float64))
    scale = _scale(peak)
    steps = np.where(scale > 0, scale, 1.0)[labels]
    return np.rint(weights / steps).astype(np.int16), scale


def _scale(peak: NDArray[np.float64]) -> F32:
    """Smallest scale of few mantissa bits that brings the peak to at most 32767."""
    mantissa, exponent = np.frexp(peak / INT16_MAX)
    steps = 2.0**SCALE_MANTISSA_BITS
    scale = np.ldexp(np.ceil(mantissa * steps) / steps, exponent)
    return np.where(scale < SMALLEST_SCALE, 0.0, scale).astype(np.float32)


SHARED_AXES: Mapping[str, tuple[int, ...]] = {
    "light_bases": (1,),
    "dual_bases": (2,),
    "means": (1,),
    "components": (2,),
    "view_texture": (0, 1),
}
"""Axes along which a factor shares its scale: one scale a cluster and column, or view column."""


def quantise_asset(asset: Asset, bits: int) -> Asset:
    """Return the asset that a reader will see when it is stored with ``bits``.

    Parameters
    ----------
    asset
        Float32 factors.
    bits
        16, or 32 for the asset itself.

    Returns
    -------
    Asset
        Normals, frames and all large factors rounded.  Render both to see what 16 bits cost.

    Raises
    ------
    ValueError
        For other bits, or frames that do not stand on the asset's normals.
    """
    if bits == 32:
        return asset
    if bits != 16:
        raise ValueError(f"bits is {bits}, not 16 or 32")
    normals = unpack_units(pack_units(asset.normals))
    parts = tuple(_quantise_part(part, asset.normals, normals) for part in asset.parts)
    return replace(asset, normals=normals, parts=parts)


def _quantise_part(part: Part, exact_normals: F32, normals: F32) -> Part:
    values, scale = quantise_weights(part.weights, part.labels, part.n_clusters)
    new: dict[str, Any] = {"weights": values.astype(np.float32) * scale[part.labels]}
    for name, axes in SHARED_AXES.items():
        array = getattr(part, name)
        if array is not None:
            new[name] = quantise(array, axes).dequantised()
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
