"""The quarter turn about y on real spherical harmonics, degree by degree."""

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from prtbake_workers.arrays import F64, Float64


@lru_cache(maxsize=8)
def quarter_turns(order: int) -> tuple[Float64[F64, "parts parts"], ...]:
    """Give what turning by 90 degrees about y (z becomes x) does to the coefficients of a degree.

    Parameters
    ----------
    order
        Degrees 0 to order - 1.

    Returns
    -------
    tuple of ndarray
        For degree l a matrix Q over the parts (cos 0, sin 0, cos 1, sin 1, ... sin l) of the
        coefficients, c' = Q c.  The part sin 0, which no function has, is zero in it; the rest is
        orthogonal to 1e-15, and three quarters of it are zero by symmetry.
    """
    turns = []
    for degree, rotation in zip(range(order), _wigner_quarter_turns(), strict=False):
        parity = (-1.0) ** np.arange(degree + 1)
        signs = parity[:, None] * parity
        same = signs * rotation[degree:, degree:]
        mirrored = signs * parity[:, None] * rotation[degree::-1, degree:]
        cosines, sines = same + mirrored, same - mirrored
        cosines[0] *= np.sqrt(0.5)
        cosines[:, 0] *= np.sqrt(0.5)
        sines[0] = sines[:, 0] = 0.0
        turn = np.zeros((2 * degree + 2, 2 * degree + 2))
        turn[0::2, 0::2] = _orthogonal(cosines)
        turn[1::2, 1::2] = _orthogonal(sines)
        turns.append(turn)
    return tuple(turns)


def _orthogonal(matrix: Float64[F64, "parts parts"]) -> Float64[F64, "parts parts"]:
    """Take a step of Newton's iteration to the nearest orthogonal matrix.

    Every rotation uses the same turns: what they lack in length would add up from one rotation to
    the next (4e-13 after a thousand).
    """
    return np.asarray(1.5 * matrix - 0.5 * (matrix @ (matrix.T @ matrix)))


def _wigner_quarter_turns() -> Iterator[Float64[F64, "orders orders"]]:
    """Yield Wigner's d^l_(m'm)(pi / 2), rows and columns -l to l, for l = 0, 1, ...

    From spin j - 1/2 to spin j: the product with spin 1/2, symmetrised.  Weights are positive and
    bounded by 1, so that rounding does not grow (T. Risbo, J. Geodesy 70, 1996).
    """
    d = np.ones((1, 1))
    yield d
    doubled_spin = 0
    while True:
        doubled_spin += 1
        k = np.arange(doubled_spin)
        # cos 45 degrees = sin 45 degrees goes into one of each pair of weights
        up, stay = np.sqrt((k + 1) / doubled_spin), np.sqrt((doubled_spin - k) / doubled_spin)
        row_up, row_stay = np.sqrt(0.5) * up[:, None] * d, np.sqrt(0.5) * stay[:, None] * d
        d = np.zeros((doubled_spin + 1, doubled_spin + 1))
        d[:-1, :-1] += row_stay * stay
        d[1:, :-1] -= row_up * stay
        d[:-1, 1:] += row_stay * up
        d[1:, 1:] += row_up * up
        if doubled_spin % 2 == 0:
            yield d
