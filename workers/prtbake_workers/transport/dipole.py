"""The dipole: how light that enters a surface at one point leaves it at another.

A narrow beam into a half-space of a scattering material is replaced by two point sources on its
line: the real one a mean free path below the surface and a virtual one above, so placed that the
boundary reflects as it should.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import brentq

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.transport.diffuse_fresnel import (
    check_eta,
    entering_transmittance,
    internal_reflectance,
)
from prtbake_workers.transport.scattering_media import MEASURED_MEDIA

PATCHES_PER_CHUNK = 1 << 14
"""Patches at a time: a dozen arrays of 128 kB."""


@dataclass(frozen=True, eq=False)
class Dipole:
    """The classical dipole of [Jensen2001]_, equations 4 and 5, one channel or three.

    Attributes
    ----------
    scattering
        Reduced scattering coefficient sigma_s' in inverse scene units, not negative.  Zero: the
        channel is black, as nothing turns light back.
    absorption
        sigma_a, likewise.  Zero: all light that enters leaves again.
    eta
        Index of refraction in [1, 2.5].

    Raises
    ------
    SettingsError
        Coefficients that are negative, not finite, both zero (light would never meet anything), or
        neither one nor three; an index out of range.

    Notes
    -----
    With ``sigma_t' = sigma_s' + sigma_a``, ``alpha' = sigma_s' / sigma_t'``, ``sigma_tr =
    sqrt(3 sigma_a sigma_t')``, ``A = (1 + F_dr) / (1 - F_dr)``, depths ``z_r = 1 / sigma_t'`` and
    ``z_v = z_r (1 + 4 A / 3)``, and ``d = sqrt(r^2 + z^2)``:

        R_d(r) = alpha' / (4 pi) sum over z of z (1 + sigma_tr d) exp(-sigma_tr d) / d^3,

    power leaving a unit of area, over the power that entered at the distance r.  As printed in
    2001, equation 4 has the first term over sigma_t' and the second over sigma_t' times z_v, which
    only agree in units of the mean free path; [Jensen2002]_ has it as above.

    Everything else follows from ``Phi(r) = -alpha' / (4 pi) sum of z exp(-sigma_tr d) / d``, whose
    slope is ``r R_d(r)``.
    """

    scattering: Float64[F64, " channels"]
    absorption: Float64[F64, " channels"]
    eta: float

    def __post_init__(self) -> None:
        check_eta(self.eta)
        if self.scattering.shape != self.absorption.shape or len(self.scattering) not in (1, 3):
            raise SettingsError(
                "scattering and absorption have one channel or three, not "
                f"{len(self.scattering)} and {len(self.absorption)}"
            )
        for name in ("scattering", "absorption"):
            values = getattr(self, name)
            if not (np.isfinite(values) & (values >= 0.0)).all():
                raise SettingsError(f"{name} must be finite and not negative: {values.tolist()}")
        if not (self.scattering + self.absorption > 0.0).all():
            raise SettingsError("scattering and absorption are both zero: light meets nothing")

    @classmethod
    def per_millimetre(
        cls,
        scattering: Float64[F64, " channels"],
        absorption: Float64[F64, " channels"],
        *,
        eta: float,
        mm_per_unit: float,
    ) -> "Dipole":
        """Make one from coefficients per millimetre, as the literature has them.

        Parameters
        ----------
        scattering, absorption, eta
            sigma_s' and sigma_a per millimetre, index of refraction.
        mm_per_unit
            Millimetres to a unit of the scene, above 0.
        """
        if not (np.isfinite(mm_per_unit) and mm_per_unit > 0.0):
            raise SettingsError(f"mm_per_unit must be above 0, not {mm_per_unit}")
        return cls(scattering * mm_per_unit, absorption * mm_per_unit, eta)

    @classmethod
    def of_material(cls, name: str, *, mm_per_unit: float) -> "Dipole":
        """Make one of a measured material (see `MEASURED_MEDIA`)."""
        medium = MEASURED_MEDIA.get(name)
        if medium is None:
            raise SettingsError(f"no material {name!r}; there are {', '.join(MEASURED_MEDIA)}")
        return cls.per_millimetre(
            medium.scattering, medium.absorption, eta=medium.eta, mm_per_unit=mm_per_unit
        )

    @property
    def n_channels(self) -> int:
        """1 or 3."""
        return len(self.scattering)

    @cached_property
    def mean_free_path(self) -> Float64[F64, " channels"]:
        """1 / sigma_t', in scene units."""
        return np.asarray(1.0 / (self.scattering + self.absorption))

    @cached_property
    def albedo(self) -> Float64[F64, " channels"]:
        """alpha', the share of light that a meeting does not absorb."""
        return np.asarray(self.scattering / (self.scattering + self.absorption))

    @cached_property
    def decay(self) -> Float64[F64, " channels"]:
        """sigma_tr, the rate at which diffuse light dies out, in inverse scene units."""
        # roots apart: the product would leave float64 at both ends
        return np.asarray(
            np.sqrt(3.0 * self.absorption) * np.sqrt(self.scattering + self.absorption)
        )

    @cached_property
    def depths(self) -> Float64[F64, "channels 2"]:
        """z_r and z_v, both positive, in scene units."""
        reflected = internal_reflectance(self.eta)
        ratio = (1.0 + reflected) / (1.0 - reflected)
        return np.asarray(self.mean_free_path[:, None] * np.array([1.0, 1.0 + 4.0 / 3.0 * ratio]))

    @cached_property
    def entering_transmittance(self) -> float:
        """Share of diffuse light that the boundary lets in (see `entering_transmittance`)."""
        return entering_transmittance(self.eta)

    def profile(self, distance: Float64[F64, " samples"]) -> Float64[F64, "channels samples"]:
        """Evaluate R_d at distances from the point of entry."""
        total = np.zeros((self.n_channels, len(distance)))
        squared = distance * distance
        for channel, decay in enumerate(self.decay):
            for z in self.depths[channel]:
                # a tenth of the time of np.hypot; squares of lengths stay in float64
                inverse = 1.0 / np.sqrt(squared + z * z)
                fall = decay / inverse
                series = (1.0 + fall) * np.exp(-fall)
                total[channel] += series * (z * inverse) * inverse * inverse
        return np.asarray(total * (self.albedo / (4.0 * np.pi))[:, None])

    def profile_over(
        self,
        away: Float64[F64, "samples 3"],
        spread: Float64[F64, "samples 3 3"],
    ) -> Float64[F64, "channels samples"]:
        """Average R_d over patches, to second order in their size.

        Parameters
        ----------
        away
            From the patch's centroid to the point.
        spread
            Covariance S of the patch's points: ``R_d + (tr S g + v . S v h) / 2`` with the point at
            v, where the gradient of R_d is ``g v`` and that of g is ``h v``; 0 at least.
        """
        total = np.empty((self.n_channels, len(away)))
        for start in range(0, len(away), PATCHES_PER_CHUNK):
            part = slice(start, start + PATCHES_PER_CHUNK)
            total[:, part] = self._profile_over(away[part], spread[part])
        return total

    def _profile_over(self, away: F64, spread: F64) -> Float64[F64, "channels samples"]:
        x, y, z = away.T
        xx, yy, zz = x * x, y * y, z * z
        squared = xx + yy + zz
        trace = 0.5 * (spread[:, 0, 0] + spread[:, 1, 1] + spread[:, 2, 2])
        across = 0.5 * (xx * spread[:, 0, 0] + yy * spread[:, 1, 1] + zz * spread[:, 2, 2])
        across += x * y * spread[:, 0, 1] + y * z * spread[:, 1, 2] + z * x * spread[:, 2, 0]
        total = np.zeros((self.n_channels, len(away)))
        for channel, decay in enumerate(self.decay):
            for depth in self.depths[channel]:
                inverse = 1.0 / np.sqrt(squared + depth * depth)
                fall = decay / inverse
                first = 3.0 + fall * (3.0 + fall)
                second = 15.0 + fall * (15.0 + fall * (6.0 + fall))
                series = (1.0 + fall) - trace * inverse**2 * first
                # squares of lengths apart: their product may leave float64
                series += (across * inverse**2) * inverse**2 * second
                total[channel] += series * np.exp(-fall) * (depth * inverse) * inverse * inverse
        # of patches wider than their distance the second order may take more than there is
        np.maximum(total, 0.0, out=total)
        return np.asarray(total * (self.albedo / (4.0 * np.pi))[:, None])

    @cached_property
    def total_reflectance(self) -> Float64[F64, " channels"]:
        """R_d integrated over the plane, ``alpha' / 2 (exp(-sigma_tr z_r) + exp(-sigma_tr z_v))``.

        In [0, 1]: [Jensen2001]_, equation 15 in the form of [Jensen2002]_.
        """
        exponents = -self.decay[:, None] * self.depths
        return np.asarray(0.5 * self.albedo * np.exp(exponents).sum(axis=1))

    @property
    def diffuse_albedo(self) -> Float64[F64, " channels"]:
        """F R: what a wide plane under even light gives back of what falls on it."""
        return self.entering_transmittance * self.total_reflectance

    def disc_reflectance(
        self, radius: Float64[F64, " samples"]
    ) -> Float64[F64, "channels samples"]:
        """Integrate R_d over discs about the point of entry: 2 pi (Phi(radius) - Phi(0))."""
        total = np.zeros((self.n_channels, len(radius)))
        for channel, decay in enumerate(self.decay):
            for z in self.depths[channel]:
                total[channel] += rise(radius, z, float(decay))
        return np.asarray(0.5 * total * self.albedo[:, None])

    def extent(self, share: float = 0.99) -> Float64[F64, " channels"]:
        """Give the radius in which that share of the reflected light leaves; 0 for black.

        Parameters
        ----------
        share
            In (0, 1).  Without absorption R_d falls as 1 / r^3 alone, and the radius grows as
            1 / (1 - share).
        """
        if not 0.0 < share < 1.0:
            raise SettingsError(f"share must be between 0 and 1, not {share}")
        return np.array([self._radius(channel, share) for channel in range(self.n_channels)])

    def _radius(self, channel: int, share: float) -> float:
        target = share * float(self.total_reflectance[channel])
        unit = float(self.mean_free_path[channel])
        if not target > 0.0:
            return 0.0

        def excess(radius: float) -> float:
            return float(self.disc_reflectance(np.array([radius * unit]))[channel, 0]) - target

        # what is missing beyond a radius is at most z_v over it, whatever the decay
        furthest = 1.01 * float(self.depths[channel, 1]) / unit / (1.0 - share)
        return unit * float(brentq(excess, 0.0, furthest))


def rise(radius: F64, depth: F64 | float, decay: float) -> F64:
    """Give ``z exp(-s z) / z - z exp(-s d) / d``, without cancellation near radius 0.

    With ``w = d - z = r^2 / (d + z)`` that is ``exp(-s z) ((w / d) exp(-s w) - expm1(-s w))``.
    """
    d = np.sqrt(radius * radius + depth * depth)
    further = radius * (radius / (d + depth))
    fallen = np.expm1(-decay * further)
    return np.asarray(np.exp(-decay * depth) * (further / d * (1.0 + fallen) - fallen))
