"""Sixteen-bit coefficients, [Tsai2006]_ 5.1, with the error that they cost."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.quantise import INT16_MAX, finest_scale
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F32, F64, Float32, Float64

I16 = NDArray[np.int16]

CHUNK_NUMBERS = 1 << 16
"""Coefficients rounded at a time: they and their errors in float64 stay in a cache of 1 MiB."""

ERROR_BOUND = 1.02 / (4.0 * INT16_MAX**2)
"""Squared error of one coefficient over the square of its row's largest: half a step each, the
step rounded up to few bits."""


@dataclass(frozen=True)
class QuantisedTransfer:
    """Coefficients as integers: ``coefficients ~ values * scale``.

    Attributes
    ----------
    values
        int16, (verts, terms, coeffs), within +-32767.
    scale
        One float32 a vertex and term.
    squared_error
        Squared radiance error of each vertex, coefficients being whitened.
    max_error, rms_error
        Largest and root mean square error of a coefficient.
    """

    values: I16
    scale: Float32[F32, "verts terms"]
    squared_error: Float64[F64, " verts"]
    max_error: float
    rms_error: float

    def dequantised(self) -> Float32[F32, "verts terms coeffs"]:
        """Give the coefficients back."""
        return np.asarray(self.values * self.scale[:, :, None], dtype=np.float32)


def quantise_transfer(
    coefficients: Float32[F32, "verts terms coeffs"], *, threads: int = 1
) -> QuantisedTransfer:
    """Round coefficients to 16 bits and measure what that costs.

    Parameters
    ----------
    coefficients
        Whitened, finite.
    threads
        Shares of the vertices worked on at a time; the result does not depend on it.

    Returns
    -------
    QuantisedTransfer
        Each term of each vertex has a scale of its own, so dark vertices lose no more of their
        energy than bright ones and the bytes do not depend on how vertices are cut into blocks.
        The squared error is at most ``coeffs x ERROR_BOUND`` of the row's energy: 1.6e-7 at 642
        coefficients.

    Raises
    ------
    SettingsError
        A coefficient is not finite; names vertex, term and coefficient.
    """
    n_verts, n_terms, n_coeffs = coefficients.shape
    values = np.empty(coefficients.shape, np.int16)
    scale = np.empty((n_verts, n_terms), np.float32)
    squared_error = np.zeros(n_verts)
    step = max(1, CHUNK_NUMBERS // max(1, n_terms * n_coeffs))

    def round_some(first: int, stop: int) -> float:
        """Round vertices, some at a time; give the largest error."""
        largest = 0.0
        for start in range(first, stop, step):
            part = slice(start, min(start + step, stop))
            block = coefficients[part]
            # whatever is not finite shows in its row's peak
            peak = np.maximum(
                block.max(axis=2, keepdims=True, initial=0.0),
                -block.min(axis=2, keepdims=True, initial=0.0),
            )
            if not np.isfinite(peak).all():
                vertex, term, index = np.argwhere(~np.isfinite(block))[0].tolist()
                raise SettingsError(
                    f"coefficient {index} of term {term} of vertex {start + vertex} is not finite"
                )
            own = finest_scale(peak.astype(np.float64), INT16_MAX)
            level = block / np.where(own > 0.0, own, np.inf)
            np.rint(level, out=level)
            values[part], scale[part] = level, own[..., 0]
            # exact in float32: level x scale takes 24 bits, and lies close to what it rounds
            level *= own
            error = np.subtract(block, level, out=level)
            largest = max(largest, float(error.max(initial=0.0)), -float(error.min(initial=0.0)))
            exact = error.astype(np.float64)
            squared_error[part] = np.vecdot(exact, exact).sum(axis=1)
        return largest

    bounds = np.linspace(0, n_verts, threads + 1).astype(int).tolist()
    if threads == 1:
        max_error = round_some(0, n_verts)
    else:
        with ThreadPoolExecutor(threads) as pool:
            max_error = max(pool.map(round_some, bounds[:-1], bounds[1:]))
    mean = squared_error.sum() / max(1, n_verts * n_terms * n_coeffs)
    return QuantisedTransfer(values, scale, squared_error, max_error, float(np.sqrt(mean)))
