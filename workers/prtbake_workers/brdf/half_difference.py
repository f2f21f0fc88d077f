"""Rusinkiewicz's half and difference angles, folded by the symmetries of an isotropic BRDF."""

from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import LENGTH_FLOOR


class HalfDifference(NamedTuple):
    """Angles in radians, each in [0, pi / 2] for directions above the horizon [Rusinkiewicz1998]_.

    ``phi_d`` is folded: phi_d + pi is the pair with light and view exchanged (reciprocity), -phi_d
    its mirror image.  At theta_h = 0 and at theta_d = 0 it means nothing.

    References
    ----------
    .. [Rusinkiewicz1998] S. Rusinkiewicz, "A New Change of Variables for Efficient BRDF
       Representation", 1998.
    """

    theta_h: Float64[F64, "..."]
    theta_d: Float64[F64, "..."]
    phi_d: Float64[F64, "..."]


def half_difference(wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]) -> HalfDifference:
    """Give the angles of pairs of directions; exactly the same for (wi, wo) and (wo, wi)."""
    hx, hy, hz = (wi[..., axis] + wo[..., axis] for axis in range(3))
    # wi = h + e, wo = h - e: e is the difference vector, at right angles to h
    ex, ey, ez = (wi[..., axis] - wo[..., axis] for axis in range(3))
    planar = np.sqrt(hx * hx + hy * hy)
    length = np.sqrt(planar * planar + hz * hz)
    theta_h = np.arctan2(planar, hz)
    theta_d = np.arctan2(np.sqrt(ex * ex + ey * ey + ez * ez), length)
    # e in the frame of h: x along the meridian, y across it
    at_pole = planar < LENGTH_FLOOR
    divisor = np.where(at_pole, 1.0, planar)
    cosine, sine = np.where(at_pole, 1.0, hx / divisor), np.where(at_pole, 0.0, hy / divisor)
    along = (ex * cosine + ey * sine) * np.cos(theta_h) - ez * np.sin(theta_h)
    across = ey * cosine - ex * sine
    return HalfDifference(theta_h, theta_d, np.arctan2(np.abs(across), np.abs(along)))


def directions_of(
    theta_h: Float64[F64, "..."], theta_d: Float64[F64, "..."], phi_d: Float64[F64, "..."]
) -> tuple[Float64[F64, "... 3"], Float64[F64, "... 3"]]:
    """Give (wi, wo) of the angles, with the half vector in the plane of x and z."""
    sin_h, cos_h = np.sin(theta_h), np.cos(theta_h)
    along, across = np.sin(theta_d) * np.cos(phi_d), np.sin(theta_d) * np.sin(phi_d)
    depth = np.cos(theta_d)
    ex, ey, ez = along * cos_h, across, -along * sin_h
    hx, hz = depth * sin_h, depth * cos_h
    wi = np.stack(np.broadcast_arrays(hx + ex, ey, hz + ez), axis=-1)
    wo = np.stack(np.broadcast_arrays(hx - ex, -ey, hz - ez), axis=-1)
    return wi, wo
