"""The orthonormal functions of incident light that transfer is projected on.

Two kinds: whitened Gaussian SRBFs (`WhitenedSrbfs`) and real spherical harmonics
(`SphericalHarmonics`).  Both turn a light, given as lobes, harmonics or samples, into the
coefficients that a vertex' transfer is multiplied by; that is all that a decoder asks of them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.gaussian_sh import gaussian_sh
from prtbake_storage.decode.sh import MOST_ORDER, eval_sh, order_of
from prtbake_storage.decode.sh_turn import turn_sh
from prtbake_storage.decode.srbf import Whitening, gaussian, product_matrix, whitening

F64 = NDArray[np.float64]

BasisKind = Literal["srbf", "sh"]

LIGHT_CHUNK = 8192
"""Samples a block while light is integrated: 40 MB at 642 functions."""


@runtime_checkable
class TransferBasis(Protocol):
    """What relighting asks of a basis."""

    @property
    def kind(self) -> BasisKind:
        """As bake settings name it."""
        ...

    @property
    def n_coeffs(self) -> int:
        """Functions of the basis."""
        ...

    def light_of_lobes(self, centres: F64, bandwidths: F64, coefficients: F64) -> F64:
        """Project a sum of Gaussian SRBFs.

        Parameters
        ----------
        centres, bandwidths, coefficients
            (lobes, 3) unit, (lobes,) and (lobes, channels).

        Returns
        -------
        ndarray
            (coeffs, channels): the integrals of the light with every function.
        """
        ...

    @property
    def spacing_rad(self) -> float:
        """Angle between samples of light that resolve every function."""
        ...

    def light_of_harmonics(self, coefficients: F64, rotation: F64 | None = None) -> F64:
        """Project spherical harmonics (n^2, channels), turned by (3, 3): (coeffs, channels)."""
        ...

    def light_of_samples(self, directions: F64, solid_angles: F64, radiance: F64) -> F64:
        """Integrate samples: (dirs, 3) unit, (dirs,) and (dirs, channels) to (coeffs, channels)."""
        ...

    def check(self) -> None:
        """Raise ValueError, naming the field, where the basis breaks its own rules."""
        ...


@dataclass(frozen=True, eq=False)
class WhitenedSrbfs:
    """Gaussian SRBFs of one bandwidth, orthonormalised by G^(-1/2): see docs/theory, "The metric".

    Attributes
    ----------
    centres
        (coeffs, 3) unit vectors, float64.
    bandwidth
        Of all of them, > 0.
    """

    centres: F64
    bandwidth: float

    @property
    def kind(self) -> BasisKind:
        """As bake settings name it."""
        return "srbf"

    @property
    def n_coeffs(self) -> int:
        """Centres."""
        return len(self.centres)

    @cached_property
    def whitening(self) -> Whitening:
        """Square roots of the Gram matrix: an eigen-decomposition, done once."""
        return whitening(self.centres, self.bandwidth)

    def light_of_lobes(self, centres: F64, bandwidths: F64, coefficients: F64) -> F64:
        """Project a sum of Gaussian SRBFs: ``l = G^(-1/2) A L``, [Tsai2006]_ eq. (13)."""
        overlap = product_matrix(self.centres, self.bandwidth, centres, bandwidths)
        return np.asarray(self.whitening.inv_sqrt_gram @ (overlap @ coefficients))

    @property
    def spacing_rad(self) -> float:
        """Angle between samples that integrate any of the functions: a quarter of its width."""
        return float(0.25 / np.sqrt(self.bandwidth))

    def light_of_harmonics(self, coefficients: F64, rotation: F64 | None = None) -> F64:
        """Project spherical harmonics: ``G^(-1/2) S^T c`` with S that of `gaussian_sh`.

        The light turned one way over the centres is the light over the centres turned back.
        """
        centres = self.centres if rotation is None else self.centres @ rotation
        widths = np.full(len(centres), self.bandwidth)
        overlap = gaussian_sh(order_of(len(coefficients)), centres, widths).T
        return np.asarray(self.whitening.inv_sqrt_gram @ (overlap @ coefficients))

    def light_of_samples(self, directions: F64, solid_angles: F64, radiance: F64) -> F64:
        """Integrate samples: ``G^(-1/2) sum_w Y(w)^T L(w) dw``."""
        total = np.zeros((self.n_coeffs, radiance.shape[1]))
        for start in range(0, len(directions), LIGHT_CHUNK):
            block = slice(start, start + LIGHT_CHUNK)
            flux = radiance[block] * solid_angles[block, None]
            total += gaussian(directions[block] @ self.centres.T, self.bandwidth).T @ flux
        return np.asarray(self.whitening.inv_sqrt_gram @ total)

    def check(self) -> None:
        """Refuse centres that are no list of finite vectors, and a bandwidth that is not > 0."""
        shape = np.shape(self.centres)
        if len(shape) != 2 or shape[1] != 3 or shape[0] == 0:
            raise ValueError(f"basis/centres has shape {shape}, not (coeffs, 3)")
        if self.centres.dtype != np.float64:
            raise ValueError(f"basis/centres is {self.centres.dtype}, not float64")
        if not np.isfinite(self.centres).all():
            place = tuple(int(i) for i in np.argwhere(~np.isfinite(self.centres))[0])
            raise ValueError(f"basis/centres is not finite at {place}")
        if not (np.isfinite(self.bandwidth) and self.bandwidth > 0):
            raise ValueError(f"basis/bandwidth is {self.bandwidth}, not a positive number")


@dataclass(frozen=True)
class SphericalHarmonics:
    """Real spherical harmonics of the degrees below ``order``, index l (l + 1) + m.

    Attributes
    ----------
    order
        n, 1 to 100: n^2 functions, orthonormal on the sphere.
    """

    order: int

    @property
    def kind(self) -> BasisKind:
        """As bake settings name it."""
        return "sh"

    @property
    def n_coeffs(self) -> int:
        """Functions: n^2."""
        return self.order**2

    def light_of_lobes(self, centres: F64, bandwidths: F64, coefficients: F64) -> F64:
        """Project a sum of Gaussian SRBFs, see `gaussian_sh`."""
        return np.asarray(gaussian_sh(self.order, centres, bandwidths) @ coefficients)

    @property
    def spacing_rad(self) -> float:
        """Angle between samples that integrate any of the functions: an eighth of a half wave."""
        return float(np.pi / (8.0 * self.order))

    def light_of_harmonics(self, coefficients: F64, rotation: F64 | None = None) -> F64:
        """Turn, and take the degrees that both have: the functions are orthonormal."""
        light = np.zeros((self.n_coeffs, coefficients.shape[1]))
        both = coefficients[: self.n_coeffs]
        # a turn mixes no degrees: what lies above the basis need not be turned
        light[: len(both)] = both if rotation is None else turn_sh(both, rotation)
        return light

    def light_of_samples(self, directions: F64, solid_angles: F64, radiance: F64) -> F64:
        """Integrate samples with every function."""
        total = np.zeros((self.n_coeffs, radiance.shape[1]))
        for start in range(0, len(directions), LIGHT_CHUNK):
            block = slice(start, start + LIGHT_CHUNK)
            flux = radiance[block] * solid_angles[block, None]
            total += eval_sh(self.order, directions[block]).T @ flux
        return total

    def check(self) -> None:
        """Refuse an order outside of its range."""
        if not 1 <= self.order <= MOST_ORDER:
            raise ValueError(f"basis/order is {self.order}, not in 1 to {MOST_ORDER}")
