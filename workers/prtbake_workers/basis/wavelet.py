"""Haar wavelets on a cube map: the transform, and the choice of the coefficients to keep."""

import numpy as np

from prtbake_storage.decode.cube_map import N_FACES, face_solid_angles
from prtbake_storage.decode.haar import haar, inverse_haar
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, I64, Float64, Int64

__all__ = ["haar", "inverse_haar", "largest_coefficients", "support_areas"]


def largest_coefficients(
    coefficients: Float64[F64, "coeffs channels"],
    n_kept: int,
    weights: Float64[F64, " coeffs"] | None = None,
) -> Int64[I64, " kept"]:
    """Name the coefficients with most squared radiance over all channels, in rising order.

    The wavelets are orthonormal over solid angle, so that a texel counts by its area and what is
    dropped is exactly what the choice costs: no other choice of so many leaves less.
    Coefficients of zero are never kept, but one where all are zero; of equal ones the coarser.

    Parameters
    ----------
    coefficients
        Of `haar`.
    n_kept
        At least 1 and at most all of them.
    weights
        What the squared radiance of each counts by; None is 1.  With `support_areas` those are kept
        that hold most flux, radiance times the area it spans: the area-weighted choice of
        [Ng2003]_, which leaves out small lamps for what diffuse surfaces see more of.
    """
    if not 1 <= n_kept <= len(coefficients):
        raise SettingsError(f"of {len(coefficients)} wavelets 1 to all can be kept, not {n_kept}")
    energy = (coefficients**2).sum(axis=1)
    if weights is not None:
        energy *= weights
    order = np.argsort(-energy, kind="stable")[:n_kept]
    kept = order[energy[order] > 0.0]
    return np.sort(kept if len(kept) else order[:1]).astype(np.int64)


def support_areas(resolution: int) -> Float64[F64, " coeffs"]:
    """Give the solid angle of the block of texels that each wavelet spans, in sr."""
    areas = face_solid_angles(resolution)
    face = areas.copy()
    n = resolution
    while n > 1:
        areas = areas[0::2, 0::2] + areas[1::2, 0::2] + areas[0::2, 1::2] + areas[1::2, 1::2]
        # the three wavelets of a block of 2 x 2, and its mean, which the next level takes up
        face[:n, :n] = np.tile(areas, (2, 2))
        n //= 2
    return np.tile(face.ravel(), N_FACES)
