"""Sixteen-bit coefficients, [Tsai2006]_ 5.1, with the error that they cost."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64

I16 = NDArray[np.int16]
LARGEST = 32767
CHUNK_VERTICES = 256


@dataclass(frozen=True)
class Quantised:
    """Coefficients as integers: ``coefficients ~ values * scale``.

    Attributes
    ----------
    values
        int16, (verts, terms, coeffs), within +-32767.
    scale
        float32, broadcasts against ``values``: (verts, terms, 1) or (1, terms, 1).
    squared_error
        Squared radiance error of each vertex, coefficients being whitened.
    max_error
        Largest error of a coefficient.
    rms_error
        Root of the mean squared error of a coefficient.
    """

    values: I16
    scale: Float32[F32, "scales terms 1"]
    squared_error: Float64[F64, " verts"]
    max_error: float
    rms_error: float


def to_int16(
    coefficients: Float32[F32, "verts terms coeffs"],
    *,
    scale_per: Literal["vertex", "block"] = "vertex",
) -> Quantised:
    """Round coefficients to 16 bits.

    Parameters
    ----------
    coefficients
        Whitened, finite.
    scale_per
        ``vertex`` gives each term of each vertex a scale of its own (4 bytes beside 2 x coeffs):
        the squared error is then at most ``coeffs / (4 x 32767^2)`` of that row's energy, 1.5e-7
        at 642 coefficients, and does not depend on how vertices are cut into blocks.  ``block``
        has one scale a term; a vertex much darker than the brightest of its block then loses
        more of its own energy, though the share of the block's stays small.

    Returns
    -------
    Quantised
        With its own error measured.

    Raises
    ------
    SettingsError
        A coefficient is not finite; names the vertex, term and coefficient.
    """
    n_verts, n_terms, n_coeffs = coefficients.shape
    largest = np.empty((n_verts, n_terms, 1), np.float32)
    for part in _parts(n_verts):
        largest[part, :, 0] = np.abs(coefficients[part]).max(axis=2, initial=0.0)
    if not np.isfinite(largest).all():
        where = np.argwhere(~np.isfinite(coefficients))[0].tolist()
        raise SettingsError("coefficient (vertex, term, index) {} is not finite".format(where))
    if scale_per == "block":
        largest = largest.max(axis=0, keepdims=True, initial=0.0)
    scale = largest / np.float32(LARGEST)
    values = np.empty(coefficients.shape, np.int16)
    squared_error = np.zeros(n_verts)
    max_error = 0.0
    for part in _parts(n_verts):
        own = scale[part] if scale_per == "vertex" else scale
        # a row of zeros, or one too small for float32 to divide by its scale, becomes zeros
        divisor = np.where(own > 0.0, own, np.float32(np.inf))
        scaled = np.rint(coefficients[part] / divisor)
        values[part] = np.clip(scaled, -LARGEST, LARGEST)
        error = coefficients[part].astype(np.float64) - values[part] * own.astype(np.float64)
        squared_error[part] = np.einsum("vkc,vkc->v", error, error)
        max_error = max(max_error, float(np.abs(error).max(initial=0.0)))
    mean = squared_error.sum() / max(1, n_verts * n_terms * n_coeffs)
    return Quantised(values, scale, squared_error, max_error, float(np.sqrt(mean)))


def from_int16(
    values: I16, scale: Float32[F32, "scales terms 1"]
) -> Float32[F32, "verts terms coeffs"]:
    """Give the coefficients back."""
    return np.asarray(values * scale, dtype=np.float32)


def _parts(n_verts: int) -> list[slice]:
    return [slice(start, start + CHUNK_VERTICES) for start in range(0, n_verts, CHUNK_VERTICES)]
