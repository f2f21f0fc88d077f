"""The sum of products of an isotropic BRDF: radial functions times waves of the azimuth."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.brdf.base import COSINE_FLOOR
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.hemisphere_grid import azimuthal_blocks, norm_of_order
from prtbake_workers.brdf.radial_table import RadialTable


@dataclass(frozen=True, eq=False, kw_only=True)
class AzimuthalFactorisation(Factorisation):
    """Separable approximation of an isotropic BRDF, by azimuthal orders.

    Every term is a radial function of theta times cos(m phi) or sin(m phi), the same factor on both
    sides.  Singular values of pairs stand twice.

    Attributes
    ----------
    orders, parity
        Azimuthal order m of each term, and 0 for cosine or 1 for sine.
    psi_radial, phi_radial
        The radial functions at the grid's rings.
    psi_table, phi_table
        The same at nodes, see `RadialTable`.
    """

    TABLE_ARRAYS: ClassVar[tuple[str, ...]] = (
        "orders",
        "parity",
        "psi_radial",
        "phi_radial",
        "singular_values",
        "psi_table",
        "phi_table",
    )
    CHANNELS_OF_PHI: ClassVar[tuple[str, ...]] = ("phi_radial", "phi_table")
    TABLE_NUMBERS: ClassVar = (
        "n_theta",
        "n_phi",
        "energy_lost",
        "requested_terms",
        "constant_phi",
        "note",
    )

    orders: Int32[I32, " terms"]
    parity: Int32[I32, " terms"]
    psi_radial: Float64[F64, "theta terms"]
    phi_radial: Float64[F64, "theta terms channels"]
    psi_table: Float32[F32, "nodes units"]
    phi_table: Float32[F32, "nodes units channels"]

    @property
    def n_terms(self) -> int:
        """Number of terms K."""
        return len(self.orders)

    @property
    def n_channels(self) -> int:
        """Channels of phi: 1 or 3."""
        return int(self.phi_radial.shape[2])

    @property
    def cosines(self) -> Float64[F64, " theta"]:
        """Cosines of the rings that the radial functions are given at."""
        return self.grid.cosines

    @property
    def albedo(self) -> Float32[F32, " channels"]:
        """What multiplies every colour of a part: phi where it is a constant, else one."""
        constant = self.phi_radial[0, 0] if self.is_constant_phi else np.ones(1)
        return constant.astype(np.float32)

    @cached_property
    def unit_of_term(self) -> Int32[I32, " terms"]:
        """Which radial function each term uses; the two of a pair share one."""
        return np.cumsum(self.parity == 0, dtype=np.int32) - np.int32(1)

    def eval_psi_exact(self, wi: Float64[F64, "n 3"]) -> Float64[F64, "n terms"]:
        """Evaluate the light side by its defining sum over the view grid, without a table."""
        return self._exact(wi, light_side=True)[..., 0]

    def eval_phi_exact(self, wo: Float64[F64, "n 3"]) -> Float64[F64, "n terms channels"]:
        """Evaluate the view side by its defining sum over the light grid, without a table."""
        return self._exact(wo, light_side=False)

    def radial_exact(
        self, cosines: Float64[F64, " n"], *, light_side: bool
    ) -> Float64[F64, "n units columns"]:
        """Extend the radial functions off the grid (Nystroem).

        Light side: ``psi_k(wi) = sum_o rho(wi, o) phi_k(o) cos_o^2 w``.  View side: the same sum
        over the light grid with psi, divided by the square of the singular value.  The sum over
        the azimuth is done in Fourier space, so that each term keeps its single order.

        Parameters
        ----------
        cosines
            Where; at most `base.COSINE_FLOOR` counts as the horizon's limit from above.
        light_side
            psi with one column, or phi with a column a channel.
        """
        first = self.parity == 0
        if self.is_constant_phi:
            radial = self.psi_radial[:1, first, None] if light_side else self.phi_radial[:1, first]
            return np.repeat(radial, len(cosines), axis=0)
        if self.brdf is None:
            raise ValueError("the exact extension needs the BRDF, which this factorisation lacks")
        rings, orders = self.grid.cosines, self.orders[first]
        n_phi, n_orders = self.grid.n_phi, int(orders.max()) + 1
        weight = rings * rings * self.grid.ring_weight
        at = np.maximum(cosines, COSINE_FLOOR)
        psi, phi = self.psi_radial[:, first], self.phi_radial[:, first]
        if light_side:
            blocks = azimuthal_blocks(self.brdf, at, rings, n_phi, n_orders=n_orders)[orders]
            radial = np.einsum("kioc,o,okc->ik", blocks, weight, phi, optimize=True)
            return np.asarray(radial[..., None])
        blocks = azimuthal_blocks(self.brdf, rings, at, n_phi, n_orders=n_orders)[orders]
        energy = np.einsum("i,ik->k", weight, psi * psi) * norm_of_order(orders)
        summed = np.einsum("kioc,i,ik->okc", blocks, weight, psi, optimize=True)
        return np.asarray(summed / energy[:, None])

    def greyed(self) -> "AzimuthalFactorisation":
        """Replace the channels of phi by their mean; the same where there is one."""
        if self.n_channels == 1:
            return self
        means = {name: own.mean(axis=2, keepdims=True) for name, own in self._coloured().items()}
        return replace(self, **means, brdf=None)

    def tinted(self, colour: Float64[F64, " _"]) -> "AzimuthalFactorisation":
        """Multiply phi by a colour of one channel or three; psi and the values stay."""
        tinted = {name: own * colour.astype(own.dtype) for name, own in self._coloured().items()}
        return replace(self, **tinted, brdf=None)

    def _coloured(self) -> dict[str, Any]:
        """Give the arrays that hold a channel of phi on their third axis."""
        return {name: getattr(self, name) for name in self.CHANNELS_OF_PHI}

    @cached_property
    def _psi(self) -> RadialTable:
        values = self.psi_table[..., None]
        return RadialTable(values, self.unit_of_term, self.orders, self.parity)

    @cached_property
    def _phi(self) -> RadialTable:
        return RadialTable(self.phi_table, self.unit_of_term, self.orders, self.parity)

    def _exact(
        self, directions: Float64[F64, "n 3"], *, light_side: bool
    ) -> Float64[F64, "n terms columns"]:
        radial = self.radial_exact(directions[:, 2], light_side=light_side)[:, self.unit_of_term]
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        angle = azimuth[:, None] * self.orders - self.parity * (0.5 * np.pi)
        value: F64 = np.where(directions[:, 2] > 0.0, np.cos(angle).T, 0.0).T[..., None] * radial
        return value
