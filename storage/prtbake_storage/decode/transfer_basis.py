"""The orthonormal functions of incident light that transfer is projected on.

Two kinds: whitened Gaussian SRBFs (`WhitenedSrbfs`) and real spherical harmonics
(`SphericalHarmonics`).  Both turn the lobes of a fitted light into the coefficients that a vertex'
transfer is multiplied by; that is all that a decoder asks of them.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.gaussian_sh import gaussian_sh
from prtbake_storage.decode.sh import MOST_ORDER
from prtbake_storage.decode.srbf import Whitening, product_matrix, whitening

F64 = NDArray[np.float64]

BasisKind = Literal["srbf", "sh"]


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

    def check(self) -> None:
        """Refuse an order outside of its range."""
        if not 1 <= self.order <= MOST_ORDER:
            raise ValueError(f"basis/order is {self.order}, not in 1 to {MOST_ORDER}")
