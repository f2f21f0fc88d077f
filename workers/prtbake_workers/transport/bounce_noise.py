"""What the rays of the bounce operator cost: its own error, from two draws of some rows."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from prtbake_workers.arrays import F32, F64, Float32, Float64


def bounce_noise(
    direct: Float32[F32, "verts coeffs"], first: Sequence[Any], second: Sequence[Any]
) -> Float64[F64, " rows"]:
    """Estimate the squared radiance error of one bounce, row by row, summed over channels.

    With F1 and F2 built from different seeds and T the transfer, both unbiased and independent,
    ``E |F1 T - F2 T|^2 / 2`` is the expected squared error of either: a few hundred rows spread
    over the surface tell what the number of rays costs.

    Parameters
    ----------
    direct
        T, whitened.
    first, second
        The same rows of the operators, one matrix a channel, from two seeds.

    Returns
    -------
    array
        Squared errors.  Divide their area-weighted sum by the squared norm of the transfer of the
        same rows for a ratio.  Later bounces add less: their light has been averaged before.
    """
    return np.asarray(
        sum(
            np.square((one - other) @ direct, dtype=np.float64).sum(axis=1)
            for one, other in zip(first, second, strict=True)
        )
        * 0.5
    )
