"""A BRDF as a short sum of products, ``rho(wi, wo) ~ sum_k psi_k(wi) phi_k(wo)``."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from prtbake_storage.errors import CorruptArtefact
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.brdf.base import Brdf
from prtbake_workers.brdf.hemisphere_grid import HemisphereGrid


@runtime_checkable
class SideTable(Protocol):
    """One side of all terms, tabulated."""

    def evaluate(self, directions: Float64[F64, "n 3"]) -> Float64[F64, "n terms columns"]:
        """Evaluate in float64; 0 below the horizon."""
        ...

    def look_up(
        self,
        x: Float32[F32, " n"],
        y: Float32[F32, " n"],
        z: Float32[F32, " n"],
        out: Float32[F32, "terms n"] | None = None,
    ) -> Float32[F32, "terms n"]:
        """Evaluate the first column in float32, one contiguous row a term."""
        ...


@dataclass(frozen=True, eq=False, kw_only=True)
class Factorisation(ABC):
    """Separable approximation of a BRDF, [Tsai2006]_ eq. (9).

    ``psi`` (light side) holds the singular values; ``phi`` (view side) is orthonormal under the
    weight cos_o^2 d omega, summed over channels.  Neither holds a cosine.

    Attributes
    ----------
    grid
        Grid on which the BRDF was sampled.
    singular_values
        All of the weighted matrix, falling, as often as they occur; in units of the continuous
        norm.
    energy_lost
        Share of the squared norm (weight cos_i^2 cos_o^2) outside the terms kept: on the grid, or,
        where that does not resolve the lobe, measured on a finer one.
    requested_terms
        What was asked for, where a number was.
    note
        What a reader of the report should know about the choice of terms; None if nothing.
    is_constant_phi
        The BRDF is a constant: one term, psi = 1 / pi and phi = albedo (not normalised).
    brdf
        The BRDF itself, for the exact extension; absent when read from storage.

    References
    ----------
    .. [Tsai2006] Y.-T. Tsai, Z.-C. Shih, "All-Frequency Precomputed Radiance Transfer using
       Spherical Radial Basis Functions and Clustered Tensor Approximation", 2006.
    """

    TABLE_ARRAYS: ClassVar[tuple[str, ...]]
    """Attributes that storage holds as arrays."""
    TABLE_NUMBERS: ClassVar[tuple[str, ...]]
    """What else it holds."""

    grid: HemisphereGrid
    singular_values: Float64[F64, " values"]
    energy_lost: float
    requested_terms: int | None
    note: str | None
    is_constant_phi: bool
    brdf: Brdf | None = None

    @property
    @abstractmethod
    def n_terms(self) -> int:
        """Number of terms K."""

    @property
    @abstractmethod
    def n_channels(self) -> int:
        """Channels of phi: 1 or 3."""

    @property
    @abstractmethod
    def albedo(self) -> Float32[F32, " channels"]:
        """What multiplies every colour of a part: phi where it is a constant, else one."""

    @property
    def is_black(self) -> bool:
        """Whether a part reflects nothing: then nothing that befalls its light is seen."""
        return not self.albedo.any()

    @property
    @abstractmethod
    def _psi(self) -> SideTable:
        """The light side."""

    @property
    @abstractmethod
    def _phi(self) -> SideTable:
        """The view side."""

    def eval_psi(self, wi: Float64[F64, "n 3"]) -> Float64[F64, "n terms"]:
        """Evaluate the light side, without cosine; 0 below the horizon."""
        return self._psi.evaluate(wi)[..., 0]

    def eval_phi(self, wo: Float64[F64, "n 3"]) -> Float64[F64, "n terms channels"]:
        """Evaluate the view side, without cosine; 0 below the horizon."""
        return self._phi.evaluate(wo)

    def psi_lookup(
        self,
        x: Float32[F32, " n"],
        y: Float32[F32, " n"],
        z: Float32[F32, " n"],
        out: Float32[F32, "terms n"] | None = None,
    ) -> Float32[F32, "terms n"]:
        """Evaluate the light side fast: float32, local components in, one contiguous row a term."""
        return self._psi.look_up(x, y, z, out)

    @abstractmethod
    def greyed(self) -> "Factorisation":
        """Replace the channels of phi by their mean; the same where there is one."""

    @abstractmethod
    def tinted(self, colour: Float64[F64, " _"]) -> "Factorisation":
        """Multiply phi by a colour of one channel or three; psi and the values stay."""

    def tables(self) -> dict[str, Any]:
        """Give everything but the BRDF as small arrays and plain values, for storage."""
        numbers = {
            "n_theta": self.grid.n_theta,
            "n_phi": self.grid.n_phi,
            "energy_lost": self.energy_lost,
            "requested_terms": -1 if self.requested_terms is None else self.requested_terms,
            "constant_phi": self.is_constant_phi,
            "note": self.note or "",
        }
        arrays = {name: getattr(self, name) for name in self.TABLE_ARRAYS}
        return arrays | {name: numbers[name] for name in self.TABLE_NUMBERS}

    @classmethod
    def from_tables(cls, tables: Mapping[str, Any], *, brdf: Brdf | None = None) -> "Factorisation":
        """Rebuild from `tables`; with the BRDF given the exact extension works again.

        Raises
        ------
        CorruptArtefact
            An entry is missing; the message names it.
        """
        missing = [name for name in cls.TABLE_ARRAYS + cls.TABLE_NUMBERS if name not in tables]
        if missing:
            raise CorruptArtefact(f"the factorisation's tables lack {', '.join(missing)}")
        requested = int(tables["requested_terms"])
        arrays: dict[str, Any] = {name: np.asarray(tables[name]) for name in cls.TABLE_ARRAYS}
        return cls(
            **arrays,
            grid=HemisphereGrid(int(tables["n_theta"]), int(tables["n_phi"])),
            energy_lost=float(tables["energy_lost"]),
            requested_terms=None if requested < 0 else requested,
            note=str(tables["note"]) or None,
            is_constant_phi=bool(tables.get("constant_phi", False)),
            brdf=brdf,
        )
