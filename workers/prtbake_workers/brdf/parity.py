"""BRDFs that are mirror-symmetric about x and about y, split by the parities of their functions.

Such a BRDF maps functions that are even or odd in x and in y to functions of the same parities: its
matrix on a grid that is symmetric itself falls into four blocks, each over one quadrant.
"""

from collections.abc import Iterator

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F64, I32, Float64, Int32
from prtbake_workers.brdf.base import Brdf

PARITIES = ((0, 0), (1, 0), (0, 1), (1, 1))
"""1 where a function is odd in x, and 1 where it is odd in y."""

VALUES_A_PASS = 500_000
"""BRDF values evaluated at once: bounds their memory to some tens of MiB."""


def quadrant_azimuths(n_phi: int) -> Float64[F64, " quad"]:
    """Azimuths of the first quadrant, n_phi / 4 midpoints, of a grid that has ``n_phi`` a ring."""
    return np.asarray((np.arange(n_phi // 4) + 0.5) * (2.0 * np.pi / n_phi))


def ring_directions(
    cosines: Float64[F64, " n"], azimuths: Float64[F64, " m"]
) -> Float64[F64, "n m 3"]:
    """Give directions ring by ring."""
    sines = np.sqrt(1.0 - cosines * cosines)[:, None]
    x, y = sines * np.cos(azimuths), sines * np.sin(azimuths)
    return np.stack(np.broadcast_arrays(x, y, cosines[:, None]), axis=-1)


def parity_rows(
    brdf: Brdf, wi: Float64[F64, "n 3"], wo: Float64[F64, "m 3"]
) -> Iterator[tuple[slice, Float64[F64, "parities rows m channels"]]]:
    """Sum the BRDF over the four mirror images of each wo, with the signs of each parity.

    ``block(i, o) = sum over images a of sign(a) rho(wi, a wo)``: integrated over the quadrant of wo
    with a function of that parity, it gives what rho gives over the hemisphere.

    Parameters
    ----------
    wi
        Anywhere above the horizon.
    wo
        In the first quadrant.

    Yields
    ------
    rows, blocks
        Some of the light directions at a time; blocks in the order of `PARITIES`.

    Raises
    ------
    BrdfError
        A value is negative or not finite; the message gives the directions.
    """
    images = [wo * np.array([1 - 2 * a, 1 - 2 * b, 1.0]) for a, b in PARITIES]
    signs = np.array([[(-1.0) ** (p * a + q * b) for a, b in PARITIES] for p, q in PARITIES])
    step = max(1, VALUES_A_PASS // (4 * len(wo)))
    for start in range(0, len(wi), step):
        rows = slice(start, start + step)
        values = [brdf.eval_brdf(wi[rows, None], image) for image in images]
        for value, image in zip(values, images, strict=True):
            _check_values(value, wi[rows], image)
        yield rows, np.einsum("pa,aioc->pioc", signs, np.stack(values))


def _check_values(
    value: Float64[F64, "n m channels"], wi: Float64[F64, "n 3"], wo: Float64[F64, "m 3"]
) -> None:
    if value.min() >= 0.0 and np.isfinite(value.max()):  # a NaN fails the first comparison
        return
    i, o, _ = np.argwhere(~(np.isfinite(value) & (value >= 0.0)))[0]
    raise BrdfError(
        f"the BRDF is {value[i, o].tolist()} at wi = {np.round(wi[i], 6).tolist()}, "
        f"wo = {np.round(wo[o], 6).tolist()}"
    )


def waves(
    parity: tuple[int, int], azimuths: Float64[F64, " n"], n_phi: int
) -> Float64[F64, "n quad"]:
    """Evaluate the waves of one parity that the grid tells apart: cos or sin of m phi.

    Cosines are even in y and sines odd; even orders are in x what they are in y, odd ones the
    opposite.
    """
    odd_x, odd_y = parity
    n_quad = n_phi // 4
    first = 1 if odd_x != odd_y else 2 * odd_y
    angle = azimuths[:, None] * (first + 2 * np.arange(n_quad))
    return np.sin(angle) if odd_y else np.cos(angle)


def interpolation(
    parity: tuple[int, int], azimuths: Float64[F64, " n"], n_phi: int
) -> Float64[F64, "n quad"]:
    """Take values at the quadrant's azimuths to any azimuth, by the waves through them."""
    at_grid = waves(parity, quadrant_azimuths(n_phi), n_phi)
    return np.asarray(np.linalg.solve(at_grid.T, waves(parity, azimuths, n_phi).T).T)


def terms_of_parity(
    parity: Int32[I32, "terms 2"],
) -> Iterator[tuple[int, tuple[int, int], np.ndarray]]:
    """Give for each parity that occurs its place in `PARITIES`, itself, and its terms."""
    for place, (odd_x, odd_y) in enumerate(PARITIES):
        terms = np.flatnonzero((parity == (odd_x, odd_y)).all(axis=1))
        if len(terms):
            yield place, (odd_x, odd_y), terms
