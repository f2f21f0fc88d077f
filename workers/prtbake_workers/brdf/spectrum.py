"""Singular values: the spectrum of a BRDF, and how many terms an error asks for."""

from dataclasses import dataclass

import numpy as np

from prtbake_workers.arrays import F64, I32, Float64, Int32

RANK_FLOOR = 1e-7
"""Singular values below this share of the largest are noise: their terms carry less than 1e-14 of
the energy, while an extension of phi divides by them."""


TIE_TOLERANCE = 1e-6
"""Relative difference below which neighbours in the spectrum count as equal: their functions may be
mixed at will, and one of them kept without the other would depend on rounding."""

TIE_ROUNDING = 1e-13
"""The same, relative to the largest value: what a decomposition in float64 leaves."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Spectrum:
    """Units of the spectrum, the strongest first, that are kept or dropped as a whole.

    Attributes
    ----------
    values
        Singular values, falling.
    multiplicity
        How often the value stands in the whole spectrum.
    usable
        How many units, from the front, a basis may use.
    """

    values: Float64[F64, " units"]
    multiplicity: Int32[I32, " units"]
    usable: int

    @classmethod
    def from_values(cls, falling: Float64[F64, " values"]) -> "Spectrum":
        """Gather equal singular values, from whatever blocks they come, to units."""
        tie = TIE_TOLERANCE * falling[:-1] + TIE_ROUNDING * falling[0]
        first = np.flatnonzero(np.append(True, falling[:-1] - falling[1:] > tie))
        multiplicity = np.diff(np.append(first, len(falling)))
        # the energy of a unit is that of its values
        values = np.sqrt(np.add.reduceat(falling**2, first) / multiplicity)
        usable = int(np.count_nonzero(values > RANK_FLOOR * values[0]))
        return cls(values=values, multiplicity=multiplicity.astype(np.int32), usable=max(usable, 1))

    @property
    def all_values(self) -> Float64[F64, " n"]:
        """Every singular value of the whole matrix, falling; pairs stand twice."""
        return -np.sort(-np.repeat(self.values, self.multiplicity))

    @property
    def whole_counts(self) -> Int32[I32, " usable"]:
        """Numbers of terms that split no pair, rising."""
        return np.cumsum(self.multiplicity[: self.usable], dtype=np.int32)

    @property
    def energies_left(self) -> Float64[F64, " usable"]:
        """Share of the energy outside the first 1, 2, ... usable units."""
        energy = self.multiplicity * self.values**2
        # summed from the small end, so that a tiny share is not a difference of large sums
        tail = np.cumsum(energy[::-1])[::-1]
        after = np.append(tail[1:], 0.0)[: self.usable]
        left: F64 = after / tail[0]
        return left

    def units_for_terms(self, n_terms: int) -> int:
        """Give the most units that make at most ``n_terms`` terms; at least one."""
        return max(1, int(np.searchsorted(self.whole_counts, n_terms, side="right")))

    def units_for_energy(self, energy_lost: float) -> int | None:
        """Give the fewest units that leave at most ``energy_lost``; None if no number does."""
        serving = np.flatnonzero(self.energies_left <= energy_lost)
        return int(serving[0]) + 1 if len(serving) else None


@dataclass(frozen=True, eq=False, kw_only=True)
class AzimuthalSpectrum(Spectrum):
    """The spectrum of an isotropic BRDF: a unit is a single term (m = 0), or a pair (m > 0).

    Ties keep the lower order first.  Units of the grid's last order, whose partner the grid cannot
    see, stand at the end, out of sequence.

    Attributes
    ----------
    orders
        Azimuthal order m of each unit.
    index
        Place of each unit within its order.
    """

    orders: Int32[I32, " units"]
    index: Int32[I32, " units"]

    @classmethod
    def from_blocks(cls, values: Float64[F64, "orders per_order"]) -> "AzimuthalSpectrum":
        """Sort the singular values of the blocks of orders 0 to the last."""
        n_orders, per_order = values.shape
        orders = np.repeat(np.arange(n_orders, dtype=np.int32), per_order)
        index = np.tile(np.arange(per_order, dtype=np.int32), n_orders)
        last = orders == n_orders - 1
        rank = np.lexsort((-values.ravel(), last))
        orders, index, last, flat = orders[rank], index[rank], last[rank], values.ravel()[rank]
        return cls(
            orders=orders,
            index=index,
            values=flat,
            multiplicity=np.where((orders == 0) | last, 1, 2).astype(np.int32),
            usable=int(np.count_nonzero(~last & (flat > RANK_FLOOR * flat.max()))),
        )


def energy_lost_by_terms(singular_values: Float64[F64, " n"], n_terms: int) -> float:
    """Share of the energy after the first ``n_terms`` values; splits a pair where it must."""
    energy = singular_values**2
    return float(energy[n_terms:][::-1].sum() / energy.sum())
