"""Fitted lights as plain numpy arrays: sums of lobes, of spherical harmonics, of Haar wavelets.

Whatever it is made of, a light says what shines from a direction, and what an orthonormal basis of
incident light sees of it; a decoder asks for nothing else.  A turn R of a light is L(R^T d).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.decode.cube_map import N_FACES, cube_texel_of, cube_texels
from prtbake_storage.decode.haar import check_resolution, inverse_haar
from prtbake_storage.decode.sh import MOST_ORDER, eval_sh, order_of
from prtbake_storage.decode.srbf import gaussian
from prtbake_storage.decode.transfer_basis import TransferBasis
from prtbake_storage.errors import SettingsError

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

LightMethod = Literal["srbf_scattered", "srbf_uniform", "sh", "wavelet"]
"""How a light is fitted, as settings name it."""

LobeMethod = Literal["srbf_scattered", "srbf_uniform"]

VALUES_AT_A_TIME = 1 << 22
"""Of functions in directions: 32 MiB."""

MOST_SAMPLES_ALONG = 1024
"""Of a face of the cube map that wavelets are integrated on, 400 MB in all.  The narrowest basis
that bakes make asks for 896; a crafted one could ask for any number."""


@runtime_checkable
class Light(Protocol):
    """What relighting asks of a light."""

    def radiance(self, directions: F64) -> F64:
        """Give the linear radiance (dirs, 3) from unit directions (dirs, 3); may be negative."""
        ...

    def on_basis(self, basis: TransferBasis, rotation: F64 | None = None) -> F64:
        """Give the integrals (coeffs, 3) of the light, turned by (3, 3), with every function."""
        ...


@dataclass(frozen=True, kw_only=True)
class LightFit:
    """An environment as a sum of Gaussian SRBFs, L(d) = sum_j L_j G(d . xi_j; lam_j).

    ``centres`` (lobes, 3) unit, ``bandwidths`` (lobes,) positive, ``coefficients`` (lobes, 3)
    linear RGB radiance; ``error`` is the squared-error ratio of the fit.  [Tsai2006]_ eq. (21).
    ``method`` tells scattered lobes from those of one bandwidth on fixed centres.
    """

    centres: F64
    bandwidths: F64
    coefficients: F64
    error: float = 0.0
    provenance: Mapping[str, Any] = field(default_factory=dict)
    method: LobeMethod = "srbf_scattered"

    def radiance(self, directions: F64) -> F64:
        """Sum the lobes."""
        return np.concatenate(
            [
                gaussian(block @ self.centres.T, self.bandwidths) @ self.coefficients
                for block in _blocks(directions, len(self.centres))
            ]
        )

    def on_basis(self, basis: TransferBasis, rotation: F64 | None = None) -> F64:
        """Project in closed form; turning the centres is exact."""
        centres = self.centres if rotation is None else self.centres @ rotation.T
        return basis.light_of_lobes(centres, self.bandwidths, self.coefficients)

    @property
    def power(self) -> F64:
        """Integral over the sphere, (3,): 2 pi (1 - exp(-2 lam)) / lam of each lobe."""
        integrals = -2.0 * np.pi * np.expm1(-2.0 * self.bandwidths) / self.bandwidths
        return np.asarray(integrals @ self.coefficients)

    def check(self) -> None:
        """Raise ValueError where a bandwidth is not positive or no centre is there."""
        if not len(self.centres):
            raise ValueError("centres are empty")
        if not (self.bandwidths > 0).all():
            raise ValueError("bandwidths are not all positive")


@dataclass(frozen=True, kw_only=True)
class HarmonicLight:
    """An environment in the spherical harmonics below an order: ``coefficients`` (order^2, 3)."""

    coefficients: F64
    error: float = 0.0
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> LightMethod:
        """As settings name it."""
        return "sh"

    @property
    def order(self) -> int:
        """Bands n of n^2 functions."""
        return order_of(len(self.coefficients))

    def radiance(self, directions: F64) -> F64:
        """Sum the series."""
        order = self.order
        blocks = _blocks(directions, order**2)
        return np.concatenate([eval_sh(order, block) @ self.coefficients for block in blocks])

    def on_basis(self, basis: TransferBasis, rotation: F64 | None = None) -> F64:
        """Project in closed form."""
        return basis.light_of_harmonics(self.coefficients, rotation)

    @property
    def power(self) -> F64:
        """Integral over the sphere, (3,): that of the constant function."""
        return np.asarray(np.sqrt(4.0 * np.pi) * self.coefficients[0])

    def check(self) -> None:
        """Raise ValueError for a number of coefficients that is no order up to 100."""
        try:
            order = self.order
        except SettingsError as error:
            raise ValueError(f"coefficients: {error}") from error
        if order > MOST_ORDER:
            raise ValueError(f"coefficients are of order {order}, above {MOST_ORDER}")


@dataclass(frozen=True, kw_only=True)
class WaveletLight:
    """An environment on a cube map of N x N texels a face, in few of its Haar wavelets.

    ``indices`` (kept,) rise and name the coefficients as `prtbake_storage.decode.haar` lays them
    out, ``coefficients`` (kept, 3) are theirs; all others are zero.
    """

    resolution: int
    indices: I32
    coefficients: F64
    error: float = 0.0
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @property
    def method(self) -> LightMethod:
        """As settings name it."""
        return "wavelet"

    @cached_property
    def texels(self) -> F64:
        """Radiance (6 N^2, 3) of the cube map."""
        dense = np.zeros((N_FACES * self.resolution**2, 3))
        dense[self.indices] = self.coefficients
        return inverse_haar(dense, self.resolution)

    def radiance(self, directions: F64) -> F64:
        """Look the texels up."""
        return np.asarray(self.texels[cube_texel_of(directions, self.resolution)])

    def on_basis(self, basis: TransferBasis, rotation: F64 | None = None) -> F64:
        """Integrate over the texels, cut into parts that resolve the basis, turned.

        Raises
        ------
        SettingsError
            The basis is narrower than any that bakes make.
        """
        # a texel is widest in the middle of a face
        parts = np.ceil(2.0 / self.resolution / basis.spacing_rad)
        if not self.resolution * parts <= MOST_SAMPLES_ALONG:
            raise SettingsError(
                f"the basis has functions that samples {basis.spacing_rad:.3g} rad apart resolve: "
                f"a light of wavelets takes {MOST_SAMPLES_ALONG} along a face of its cube at most",
                pointer="/basis/bandwidth",
            )
        directions, solid_angles, owners = cube_texels(self.resolution, max(1, int(parts)))
        if rotation is not None:
            directions = directions @ rotation.T
        return basis.light_of_samples(directions, solid_angles, self.texels[owners])

    @property
    def power(self) -> F64:
        """Integral over the sphere, (3,)."""
        _, solid_angles, _ = cube_texels(self.resolution)
        return np.asarray(solid_angles @ self.texels)

    def check(self) -> None:
        """Raise ValueError for a resolution that cannot be halved and indices not of it."""
        check_resolution(self.resolution)
        if not len(self.indices):
            raise ValueError("indices are empty")
        steps = np.diff(self.indices.astype(np.int64))
        last = N_FACES * self.resolution**2 - 1
        if self.indices[0] < 0 or self.indices[-1] > last or (steps <= 0).any():
            raise ValueError(f"indices do not rise from 0 or more to {last} or less")


def _blocks(directions: F64, n_functions: int) -> list[F64]:
    """Cut directions so that their values stay within `VALUES_AT_A_TIME`."""
    step = max(1, VALUES_AT_A_TIME // n_functions)
    return [directions[i : i + step] for i in range(0, max(len(directions), 1), step)]


FittedLight = LightFit | HarmonicLight | WaveletLight
"""What a file of kind ``light`` holds."""


@dataclass(frozen=True)
class LightSum:
    """Several lights that shine together.

    Parameters
    ----------
    lights
        Of any kind, sums among them.
    factors
        Of each one's radiance; None leaves all as they are.
    rotations
        (3, 3) of each by itself, before a turn of the whole; None turns none.

    Raises
    ------
    ValueError
        Not one factor or rotation a light.
    """

    lights: tuple[Light, ...]
    factors: tuple[float, ...] | None = None
    rotations: tuple[F64 | None, ...] | None = None

    def __post_init__(self) -> None:
        """Count."""
        for name in ("factors", "rotations"):
            own = getattr(self, name)
            if own is not None and len(own) != len(self.lights):
                raise ValueError(f"{len(own)} {name} for {len(self.lights)} lights")

    def radiance(self, directions: F64) -> F64:
        """Sum the lights."""
        total = np.zeros((len(directions), 3))
        for light, factor, own in self._each():
            total += factor * light.radiance(directions if own is None else directions @ own)
        return total

    def on_basis(self, basis: TransferBasis, rotation: F64 | None = None) -> F64:
        """Sum what the basis sees of each: projection is linear."""
        total = np.zeros((basis.n_coeffs, 3))
        for light, factor, own in self._each():
            turn = own if rotation is None else rotation if own is None else rotation @ own
            total += factor * light.on_basis(basis, turn)
        return total

    def _each(self) -> list[tuple[Light, float, F64 | None]]:
        n = len(self.lights)
        factors = self.factors or (1.0,) * n
        rotations = self.rotations or (None,) * n
        return list(zip(self.lights, factors, rotations, strict=True))
