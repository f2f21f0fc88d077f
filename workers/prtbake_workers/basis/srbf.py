"""SRBF bases of one bandwidth on fixed centres: evaluation, metric, projection, light."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.srbf import (
    CONDITION_LIMIT,
    Whitening,
    gaussian,
    gaussian_product_integral,
    gram_matrix,
)
from prtbake_storage.decode.transfer_basis import WhitenedSrbfs
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.projection import Projecting

__all__ = [
    "SrbfBasis",
    "WhitenedBasis",
    "abel_poisson",
    "abel_poisson_product_integral",
    "default_bandwidth",
    "gaussian",
    "gaussian_product_integral",
]

Reals = float | np.floating[Any] | NDArray[Any]
"""What kernels take: a number or an array; they broadcast."""

SAFE_BANDWIDTH_PER_CENTRE = 40.0 / 642.0
"""Condition 2.4e7 on icosphere centres: what an error message offers instead."""


def abel_poisson(cos_angle: Reals, lam: Reals) -> F64:
    """Evaluate the Abel-Poisson SRBF, [Tsai2006]_ eq. (3).

    ``G(t; lam) = (1 - lam^2) / (1 - 2 lam t + lam^2)^(3/2)``

    Parameters
    ----------
    cos_angle
        t, cosine of the angle between direction and centre, in [-1, 1].
    lam
        Bandwidth, 0 < lam < 1; the nearer to 1 the narrower.

    Returns
    -------
    ndarray
        Values > 0, broadcast; the denominator is taken as ``(1 - lam)^2 + 2 lam (1 - t)``,
        which does not cancel as lam -> 1.
    """
    t = np.clip(np.asarray(cos_angle, dtype=np.float64), -1.0, 1.0)
    width = 1.0 - np.asarray(lam, dtype=np.float64)
    return _abel_poisson_from_width(t, width)


def abel_poisson_product_integral(lam_g: Reals, lam_h: Reals, cos_angle: Reals) -> F64:
    """Integrate the product of two Abel-Poisson SRBFs over the sphere.

    ``4 pi (1 - (lam_g lam_h)^2) / (1 - 2 lam_g lam_h c + (lam_g lam_h)^2)^(3/2)``

    Parameters
    ----------
    lam_g, lam_h
        Bandwidths in (0, 1).
    cos_angle
        c, cosine of the angle between the centres, in [-1, 1].

    Returns
    -------
    ndarray
        The integral in steradians, broadcast over the arguments.

    Notes
    -----
    [Tsai2006]_ eq. (5) lacks the factor 4 pi that its own eq. (2) gives.
    """
    g = np.asarray(lam_g, dtype=np.float64)
    h = np.asarray(lam_h, dtype=np.float64)
    c = np.clip(np.asarray(cos_angle, dtype=np.float64), -1.0, 1.0)
    # 1 - g h without the rounding of the product
    return np.asarray(4.0 * np.pi * _abel_poisson_from_width(c, (1.0 - g) + g * (1.0 - h)))


def _abel_poisson_from_width(t: F64 | np.float64, width: F64 | np.float64) -> F64:
    lam = 1.0 - width
    return np.asarray(width * (1.0 + lam) / (width**2 + 2.0 * lam * (1.0 - t)) ** 1.5)


def default_bandwidth(n_centres: int) -> float:
    """Bandwidth that projects light transport best on icosphere centres.

    Parameters
    ----------
    n_centres
        12, 42, 162, 642, 2562 or 10242.

    Returns
    -------
    float
        60 at 642 centres, where the projection error of glossy transport has its flat minimum,
        and in proportion to the count elsewhere: the same shape relative to the spacing.
    """
    return 60.0 * n_centres / 642.0


@dataclass(frozen=True)
class WhitenedBasis:
    """A basis whose Gram matrix was solved before: all that evaluates the whitened functions.

    Attributes
    ----------
    centres
        Unit vectors.
    bandwidth
        Of all of them.
    inv_sqrt_gram
        G^(-1/2).
    """

    centres: Float64[F64, "coeffs 3"]
    bandwidth: float
    inv_sqrt_gram: Float64[F64, "coeffs coeffs"]

    def reconstruction_matrix(
        self, directions: Float64[F64, "dirs 3"]
    ) -> Float64[F64, "dirs coeffs"]:
        """Tabulate the whitened basis ``Y G^(-1/2)``: orthonormal functions on the sphere."""
        values = gaussian(directions @ self.centres.T, self.bandwidth)
        return np.asarray(values @ self.inv_sqrt_gram)

    def tables(self) -> tuple[dict[str, F64], dict[str, Any]]:
        """Give arrays and numbers that `from_tables` makes the functions of again."""
        arrays = {"centres": self.centres, "inv_sqrt_gram": self.inv_sqrt_gram}
        return arrays, {"bandwidth": self.bandwidth}

    @classmethod
    def from_tables(cls, arrays: Mapping[str, F64], numbers: Mapping[str, Any]) -> "WhitenedBasis":
        """Read back what `tables` gave."""
        return cls(arrays["centres"], numbers["bandwidth"], arrays["inv_sqrt_gram"])


class SrbfBasis(Projecting):
    """Gaussian SRBFs of one bandwidth on fixed centres, used through whitened coefficients.

    Parameters
    ----------
    centres
        Unit vectors.
    bandwidth
        Common bandwidth, > 0; None takes `default_bandwidth`.

    Attributes
    ----------
    gram
        Product integrals of the basis with itself.
    stored
        Centres and bandwidth, as files and decoders have them.
    whitening
        G^(1/2) and G^(-1/2): coefficients c and whitened t hold ``t = G^(1/2) c``.
    condition
        Condition number of the Gram matrix.

    Raises
    ------
    SettingsError
        The Gram matrix cannot be inverted in float64 (condition above 1e12): the bandwidth is
        too small, or two centres coincide.
    """

    def __init__(self, centres: Float64[F64, "coeffs 3"], bandwidth: float | None = None) -> None:
        norms = np.linalg.norm(centres, axis=1)
        bad = np.flatnonzero(~(np.abs(norms - 1.0) < 1e-6))
        if len(bad):
            raise SettingsError(f"centre {bad[0]} is no unit vector: length {norms[bad[0]]}")
        lam = default_bandwidth(len(centres)) if bandwidth is None else float(bandwidth)
        if not (np.isfinite(lam) and lam > 0.0):
            raise SettingsError(f"bandwidth must be a positive number, got {lam}")
        self.centres = centres / norms[:, None]
        self.bandwidth = lam
        self.stored = WhitenedSrbfs(self.centres, lam)
        self.whitening: Whitening = self.stored.whitening
        if not self.whitening.condition <= CONDITION_LIMIT:
            raise SettingsError(
                f"bandwidth {lam:g} is too small for {self.n} centres: the Gram matrix has "
                f"condition number {self.whitening.condition:.2g} and rank "
                f"{self.whitening.effective_rank}; a bandwidth of "
                f"{SAFE_BANDWIDTH_PER_CENTRE * self.n:g} or more works on distinct "
                f"icosphere centres, the default is {default_bandwidth(self.n):g}"
            )

    @property
    def n(self) -> int:
        """Number of centres."""
        return len(self.centres)

    @property
    def condition(self) -> float:
        """Condition number of the Gram matrix."""
        return self.whitening.condition

    @property
    def spacing_rad(self) -> float:
        """Angle between samples that integrate any of the functions: a quarter of its width."""
        return self.stored.spacing_rad

    @property
    def functions(self) -> WhitenedBasis:
        """What evaluates the whitened functions."""
        return WhitenedBasis(self.centres, self.bandwidth, self.whitening.inv_sqrt_gram)

    @cached_property
    def gram(self) -> Float64[F64, "coeffs coeffs"]:
        """Product integrals of the basis with itself."""
        return gram_matrix(self.centres, self.bandwidth)

    def evaluate(self, directions: Float64[F64, "dirs 3"]) -> Float64[F64, "dirs coeffs"]:
        """Evaluate every function in every direction (unit vectors)."""
        return gaussian(directions @ self.centres.T, self.bandwidth)

    def reconstruction_matrix(
        self, directions: Float64[F64, "dirs 3"]
    ) -> Float64[F64, "dirs coeffs"]:
        """Tabulate the whitened basis, see `WhitenedBasis`."""
        return self.functions.reconstruction_matrix(directions)

    def light_from_radiance(
        self,
        directions: Float64[F64, "texels 3"],
        solid_angles: Float64[F64, " texels"],
        radiance: Float64[F64, "texels 3"],
    ) -> Float64[F64, "coeffs 3"]:
        """Whitened light of a sampled environment: ``G^(-1/2) sum_w Y(w)^T L(w) dw``.

        Parameters
        ----------
        directions, solid_angles, radiance
            Texels of the environment, linear radiance.

        Returns
        -------
        ndarray
            Light as the basis sees it, without a fit in between.
        """
        return self.stored.light_of_samples(directions, solid_angles, radiance)
