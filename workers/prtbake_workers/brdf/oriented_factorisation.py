"""The sum of products of an anisotropic BRDF: functions that are even or odd in x and in y."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from prtbake_workers.arrays import F32, F64, I32, Float32, Float64, Int32
from prtbake_workers.brdf.base import COSINE_FLOOR
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.parity import (
    interpolation,
    parity_rows,
    quadrant_azimuths,
    ring_directions,
    terms_of_parity,
)
from prtbake_workers.brdf.quadrant_table import QuadrantTable
from prtbake_workers.brdf.radial_table import cosines_of_nodes


@dataclass(frozen=True, eq=False, kw_only=True)
class OrientedFactorisation(Factorisation):
    """Separable approximation of a BRDF that depends on the tangent.

    Every term is even or odd in x, and in y, the same on both sides.

    Attributes
    ----------
    parities
        For each term: 1 where it is odd in x, and 1 where it is odd in y.
    psi_grid, phi_grid
        The terms on the quadrant of the grid.
    psi_rings, phi_rings
        The same at equal steps of r = sqrt(1 - cos theta) and at the grid's azimuths.
    """

    TABLE_ARRAYS: ClassVar = (
        "parities",
        "psi_grid",
        "phi_grid",
        "singular_values",
        "psi_rings",
        "phi_rings",
    )
    TABLE_NUMBERS: ClassVar = ("n_theta", "n_phi", "energy_lost", "requested_terms", "note")

    parities: Int32[I32, "terms 2"]
    psi_grid: Float64[F64, "theta quad terms"]
    phi_grid: Float64[F64, "theta quad terms channels"]
    psi_rings: Float32[F32, "nodes quad terms"]
    phi_rings: Float32[F32, "nodes quad terms channels"]

    @property
    def n_terms(self) -> int:
        """Number of terms K."""
        return len(self.parities)

    @property
    def n_channels(self) -> int:
        """Channels of phi: 1 or 3."""
        return int(self.phi_grid.shape[3])

    @property
    def albedo(self) -> Float32[F32, " channels"]:
        """One: phi holds all colours."""
        return np.ones(1, np.float32)

    def rings_exact(
        self, cosines: Float64[F64, " n"]
    ) -> tuple[Float64[F64, "n quad terms"], Float64[F64, "n quad terms channels"]]:
        """Extend psi and phi to any rings, at the grid's azimuths (Nystroem).

        ``psi_k(wi) = sum_o rho(wi, o) phi_k(o) cos_o^2 w`` over the hemisphere; phi is the same sum
        with psi over the square of the singular value, the BRDF being reciprocal.

        Parameters
        ----------
        cosines
            Where; at most `base.COSINE_FLOOR` counts as the horizon's limit from above.
        """
        if self.brdf is None:
            raise ValueError("the exact extension needs the BRDF, which this factorisation lacks")
        grid, azimuths = self.grid, quadrant_azimuths(self.grid.n_phi)
        wi = ring_directions(np.maximum(cosines, COSINE_FLOOR), azimuths).reshape(-1, 3)
        wo = ring_directions(grid.cosines, azimuths).reshape(-1, 3)
        weight = wo[:, 2] ** 2 * (grid.ring_weight * 2.0 * np.pi / grid.n_phi)
        n_terms, n_channels = self.n_terms, self.n_channels
        light = self.psi_grid.reshape(-1, n_terms) * weight[:, None]
        # phi over the hemisphere has norm 1, psi the singular value
        energy = 4.0 * np.einsum("ok,ok->k", light, self.psi_grid.reshape(-1, n_terms))
        light /= energy
        view = self.phi_grid.reshape(-1, n_terms, n_channels) * weight[:, None, None]
        psi, phi = np.zeros((len(wi), n_terms)), np.zeros((len(wi), n_terms, n_channels))
        for rows, blocks in parity_rows(self.brdf, wi, wo):
            for place, _, terms in terms_of_parity(self.parities):
                block = blocks[place]
                psi[rows, terms] = np.tensordot(block, view[:, terms], ([1, 2], [0, 2]))
                for channel in range(n_channels):
                    phi[rows, terms, channel] = block[..., channel] @ light[:, terms]
        shape = (len(cosines), len(azimuths))
        return psi.reshape(*shape, n_terms), phi.reshape(*shape, n_terms, n_channels)

    def eval_psi_exact(self, wi: Float64[F64, "n 3"]) -> Float64[F64, "n terms"]:
        """Evaluate the light side by its defining sum over the view grid, without a table."""
        return self._exact(wi)[0]

    def eval_phi_exact(self, wo: Float64[F64, "n 3"]) -> Float64[F64, "n terms channels"]:
        """Evaluate the view side by its defining sum over the light grid, without a table."""
        return self._exact(wo)[1]

    def tables_of(self, n_nodes: int, fine: int) -> tuple[QuadrantTable, QuadrantTable]:
        """Tabulate the exact extension of psi and phi: ``n_nodes`` rings and ``fine`` nodes."""
        psi, phi = self.rings_exact(cosines_of_nodes(n_nodes))
        n_phi = self.grid.n_phi
        return (
            QuadrantTable.of_rings(psi[..., None], self.parities, n_phi, fine),
            QuadrantTable.of_rings(phi, self.parities, n_phi, fine),
        )

    def greyed(self) -> "OrientedFactorisation":
        """Replace the channels of phi by their mean; the same where there is one."""
        if self.n_channels == 1:
            return self
        return replace(
            self,
            phi_grid=self.phi_grid.mean(axis=3, keepdims=True),
            phi_rings=self.phi_rings.mean(axis=3, keepdims=True),
            brdf=None,
        )

    def tinted(self, colour: Float64[F64, " _"]) -> "OrientedFactorisation":
        """Multiply phi by a colour of one channel or three; psi and the values stay."""
        return replace(
            self,
            phi_grid=self.phi_grid * colour,
            phi_rings=self.phi_rings * colour.astype(np.float32),
            brdf=None,
        )

    @cached_property
    def _psi(self) -> QuadrantTable:
        rings = self.psi_rings[..., None].astype(np.float64)
        return QuadrantTable.of_rings(rings, self.parities, self.grid.n_phi)

    @cached_property
    def _phi(self) -> QuadrantTable:
        rings = self.phi_rings.astype(np.float64)
        return QuadrantTable.of_rings(rings, self.parities, self.grid.n_phi)

    def _exact(
        self, directions: Float64[F64, "n 3"]
    ) -> tuple[Float64[F64, "n terms"], Float64[F64, "n terms channels"]]:
        psi_rings, phi_rings = self.rings_exact(directions[:, 2])
        azimuth = np.arctan2(directions[:, 1], directions[:, 0])
        psi = np.zeros((len(directions), self.n_terms))
        phi = np.zeros((*psi.shape, self.n_channels))
        for _, parity, terms in terms_of_parity(self.parities):
            along = interpolation(parity, azimuth, self.grid.n_phi)
            psi[:, terms] = np.einsum("nq,nqk->nk", along, psi_rings[:, :, terms])
            phi[:, terms] = np.einsum("nq,nqkc->nkc", along, phi_rings[:, :, terms])
        above = directions[:, 2] > 0.0
        return psi * above[:, None], phi * above[:, None, None]
