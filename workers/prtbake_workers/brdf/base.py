"""What a BRDF is here, and the geometry that the models share.

All directions are unit vectors in the local frame (z is the normal) and point away from the
surface: ``wi`` towards the light, ``wo`` towards the eye.
"""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from prtbake_workers.arrays import B8, F64, Bool, Float64

COSINE_FLOOR = 1e-6
"""Smallest cosine that a denominator sees.

Microfacet models grow like 1 / (cos_i cos_o) where both directions graze and face each other; they
are held constant in the last 1e-6 rad above the horizon, 1e-12 of any cosine-weighted integral."""

LENGTH_FLOOR = 1e-12
"""Smallest |wi + wo| that a division sees; only opposite directions on the horizon come near 0."""


@runtime_checkable
class Brdf(Protocol):
    """A reciprocal BRDF of one or three channels.

    Isotropic and mirror-symmetric, unless it is an `OrientedBrdf` that says otherwise.
    """

    @property
    def n_channels(self) -> int:
        """1 for grey, 3 for linear Rec.709."""
        ...

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr, without any cosine; 0 where either direction is not above the horizon.

        Leading axes, at least one, broadcast.
        """
        ...


@runtime_checkable
class OrientedBrdf(Brdf, Protocol):
    """A BRDF that may depend on how the surface is turned about its normal; x is the tangent.

    It is mirror-symmetric about x and about y.
    """

    @property
    def is_isotropic(self) -> bool:
        """Whether its parameters leave it independent of that turn."""
        ...


def is_isotropic(brdf: Brdf) -> bool:
    """Tell whether a common turn of light and view about the normal leaves the BRDF as it is."""
    return not isinstance(brdf, OrientedBrdf) or brdf.is_isotropic


class HalfVector(NamedTuple):
    """Angles of the half vector h = (wi + wo) / |wi + wo|."""

    cos_h: Float64[F64, "..."]
    """n . h"""
    sin2_h: Float64[F64, "..."]
    """1 - (n . h)^2, from the components: no cancellation near the normal."""
    cos_d: Float64[F64, "..."]
    """wi . h = wo . h"""


def half_vector(wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]) -> HalfVector:
    """Give the angles of the half vector; finite for opposite directions too."""
    x, y, z = (wi[..., axis] + wo[..., axis] for axis in range(3))
    planar = x * x + y * y
    length = np.sqrt(planar + z * z)
    # where the sum vanishes, h is the normal: the limit of equal cosines and opposite azimuths
    vanishes = length < LENGTH_FLOOR
    divisor = np.where(vanishes, 1.0, length)
    cos_h = np.where(vanishes, 1.0, z / divisor)
    sin2_h = np.where(vanishes, 0.0, planar / (divisor * divisor))
    return HalfVector(cos_h, sin2_h, np.minimum(0.5 * length, 1.0))


def above_horizon(wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]) -> Bool[B8, "..."]:
    """Tell where light and view both stand above the surface."""
    return (wi[..., 2] > 0.0) & (wo[..., 2] > 0.0)


def clamped_cosines(
    wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
) -> tuple[Float64[F64, "..."], Float64[F64, "..."]]:
    """Give (cos_i, cos_o), each at least `COSINE_FLOOR`."""
    return np.maximum(wi[..., 2], COSINE_FLOOR), np.maximum(wo[..., 2], COSINE_FLOOR)


def v_cavities(half: HalfVector, cos_i: F64, cos_o: F64) -> F64:
    """Shadowing and masking of V-shaped grooves, ``min(1, 2 cos_h min(cos_i, cos_o) / cos_d)``."""
    cavity = 2.0 * half.cos_h * np.minimum(cos_i, cos_o) / np.maximum(half.cos_d, LENGTH_FLOOR)
    return np.asarray(np.clip(cavity, 0.0, 1.0))


def channels(*values: float | tuple[float, float, float]) -> tuple[Float64[F64, " channels"], ...]:
    """Bring reflectances to one number of channels: 3 if any of them is coloured, else 1."""
    n_channels = 3 if any(isinstance(value, tuple) for value in values) else 1
    return tuple(np.broadcast_to(np.asarray(value, np.float64), (n_channels,)) for value in values)


def schlick(
    f0: Float64[F64, " channels"], cos_d: Float64[F64, "..."]
) -> Float64[F64, "... channels"]:
    """Schlick's Fresnel term ``f0 + (1 - f0) (1 - cos_d)^5``."""
    falloff = (1.0 - cos_d) ** 5
    return f0 + (1.0 - f0) * falloff[..., None]


def diffuse_plus_lobe(
    kd: Float64[F64, " channels"],
    specular: Float64[F64, "... channels"],
    visible: Bool[B8, "..."],
) -> Float64[F64, "... channels"]:
    """``kd / pi + specular`` above the horizon and 0 below."""
    value: F64 = np.where(visible[..., None], kd / np.pi + specular, 0.0)
    return value
