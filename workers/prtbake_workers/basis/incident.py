"""What bakes and their validation ask of a basis of incident light, whichever kind it is."""

from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

from prtbake_storage.decode.transfer_basis import (
    SphericalHarmonics,
    TransferBasis,
    WhitenedSrbfs,
)
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.projection import LeastSquaresProjection
from prtbake_workers.basis.sh_basis import ShBasis
from prtbake_workers.basis.srbf import SrbfBasis, WhitenedBasis


@runtime_checkable
class OrthonormalFunctions(Protocol):
    """Functions that can be evaluated, and kept in a file."""

    def reconstruction_matrix(
        self, directions: Float64[F64, "dirs 3"]
    ) -> Float64[F64, "dirs coeffs"]:
        """Tabulate the functions in unit directions."""
        ...

    def tables(self) -> tuple[dict[str, F64], dict[str, Any]]:
        """Give arrays and numbers that `functions_from_tables` makes the functions of again."""
        ...


@runtime_checkable
class IncidentBasis(Protocol):
    """An orthonormal basis of incident light."""

    @property
    def n(self) -> int:
        """Number of functions."""
        ...

    @property
    def condition(self) -> float:
        """Condition number of the Gram matrix that was solved for."""
        ...

    @property
    def spacing_rad(self) -> float:
        """Angle between samples of light that resolve every function."""
        ...

    @property
    def stored(self) -> TransferBasis:
        """What files say of the basis, and decoders do with it."""
        ...

    @property
    def functions(self) -> OrthonormalFunctions:
        """What evaluates the functions, with all that had to be solved for."""
        ...

    def projection(
        self, directions: Float64[F64, "dirs 3"], weights: Float64[F64, " dirs"]
    ) -> LeastSquaresProjection:
        """Prepare the projection of transfer sampled in directions with solid angles."""
        ...

    def light_from_radiance(
        self,
        directions: Float64[F64, "texels 3"],
        solid_angles: Float64[F64, " texels"],
        radiance: Float64[F64, "texels 3"],
    ) -> Float64[F64, "coeffs 3"]:
        """Project a sampled environment without a fit in between."""
        ...


def basis_of(stored: TransferBasis) -> IncidentBasis:
    """Make the basis that a file names.

    Raises
    ------
    SettingsError
        The basis cannot be solved for.
    """
    match stored:
        case WhitenedSrbfs(centres, bandwidth):
            return SrbfBasis(centres, bandwidth)
        case SphericalHarmonics(order):
            return ShBasis(order)
    raise TypeError(f"no basis of kind {type(stored).__name__}")


def functions_from_tables(
    arrays: Mapping[str, F64], numbers: Mapping[str, Any]
) -> OrthonormalFunctions:
    """Read back what `OrthonormalFunctions.tables` gave."""
    kind = ShBasis if "order" in numbers else WhitenedBasis
    return kind.from_tables(arrays, numbers)
