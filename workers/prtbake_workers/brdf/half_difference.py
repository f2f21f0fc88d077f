"""Rusinkiewicz's half and difference angles, folded by the symmetries of an isotropic BRDF."""

from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.base import LENGTH_FLOOR


class HalfDifference(NamedTuple):
    """Angles in radians [Rusinkiewicz1998]_: theta_h and theta_d in [0, pi / 2] above the horizon.

    phi_d + pi is the pair with light and view exchanged (reciprocity), -phi_d its mirror image.  At
    theta_h = 0 and at theta_d = 0 phi_d means nothing.

    References
    ----------
    .. [Rusinkiewicz1998] S. Rusinkiewicz, "A New Change of Variables for Efficient BRDF
       Representation", 1998.
    """

    theta_h: Float64[F64, "..."]
    theta_d: Float64[F64, "..."]
    phi_d: Float64[F64, "..."]


class HalfFrame(NamedTuple):
    """Half vector h = (sin_h, 0, cos_h) turned into the plane of x and z, and wi in its frame."""

    sin_h: Float64[F64, "..."]
    cos_h: Float64[F64, "..."]
    along: Float64[F64, "..."]
    """Component of wi along the meridian of h; that of wo is its negative."""
    across: Float64[F64, "..."]
    """Component across it; that of wo is its negative."""
    cos_d: Float64[F64, "..."]
    """wi . h = wo . h"""


def half_frame(wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]) -> HalfFrame:
    """Turn pairs of directions into the frame of their half vector."""
    hx, hy, hz = (wi[..., axis] + wo[..., axis] for axis in range(3))
    # wi = h + e, wo = h - e: e is at right angles to h
    ex, ey, ez = (wi[..., axis] - wo[..., axis] for axis in range(3))
    planar = np.sqrt(hx * hx + hy * hy)
    length = np.sqrt(planar * planar + hz * hz)
    # where the sum vanishes, h is the normal, as in `base.half_vector`
    vanishes = length < LENGTH_FLOOR
    divisor = np.where(vanishes, 1.0, length)
    sin_h = np.where(vanishes, 0.0, planar / divisor)
    cos_h = np.where(vanishes, 1.0, hz / divisor)
    at_pole = planar < LENGTH_FLOOR
    divisor = np.where(at_pole, 1.0, planar)
    cosine, sine = np.where(at_pole, 1.0, hx / divisor), np.where(at_pole, 0.0, hy / divisor)
    along = (ex * cosine + ey * sine) * cos_h - ez * sin_h
    across = ey * cosine - ex * sine
    return HalfFrame(sin_h, cos_h, 0.5 * along, 0.5 * across, 0.5 * length)


def half_difference(wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]) -> HalfDifference:
    """Give the angles with phi_d folded by both symmetries into [0, pi / 2].

    They are the same bits for (wi, wo) and (wo, wi).
    """
    frame = half_frame(wi, wo)
    return HalfDifference(
        np.arctan2(frame.sin_h, frame.cos_h),
        np.arctan2(np.sqrt(frame.along**2 + frame.across**2), frame.cos_d),
        np.arctan2(np.abs(frame.across), np.abs(frame.along)),
    )


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
