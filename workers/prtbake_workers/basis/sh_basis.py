"""Real spherical harmonics as a basis of transfer, on the side of incident light."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from prtbake_storage.decode.sh import MOST_ORDER, eval_sh
from prtbake_storage.decode.transfer_basis import SphericalHarmonics
from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.basis.projection import Projecting
from prtbake_workers.basis.sh_light import sh_light


@dataclass(frozen=True)
class ShBasis(Projecting):
    """All real spherical harmonics of the degrees below ``order``.

    Attributes
    ----------
    order
        n, 1 to 100: n^2 functions, numbered l (l + 1) + m.

    Raises
    ------
    SettingsError
        An order out of range.

    Notes
    -----
    They are orthonormal over the sphere, but not over the texels of a cube map, which integrate
    products of two functions with an error.  A sum weighted with solid angles would let one
    coefficient leak into the others, and what it leaves would be no difference of two energies.
    Transfer is projected by the same least squares as on SRBFs, of which that sum is the limit for
    many directions: the residual is what the coefficients miss in the directions, exactly.
    """

    order: int

    def __post_init__(self) -> None:
        """Refuse an order out of range."""
        if not 1 <= self.order <= MOST_ORDER:
            raise SettingsError(f"sh_order is 1 to {MOST_ORDER}, got {self.order}")

    @property
    def n(self) -> int:
        """Functions: n^2."""
        return self.order**2

    @property
    def condition(self) -> float:
        """Condition number of the Gram matrix, which is the identity."""
        return 1.0

    @property
    def spacing_rad(self) -> float:
        """Angle between samples that integrate any of the functions: an eighth of a half wave."""
        return self.stored.spacing_rad

    @cached_property
    def stored(self) -> SphericalHarmonics:
        """What files say of the basis, and decoders do with it."""
        return SphericalHarmonics(self.order)

    @property
    def functions(self) -> "ShBasis":
        """What evaluates the functions: the basis itself."""
        return self

    def tables(self) -> tuple[dict[str, F64], dict[str, Any]]:
        """Give arrays and numbers that `from_tables` makes the basis of again."""
        return {}, {"order": self.order}

    @classmethod
    def from_tables(cls, arrays: Mapping[str, F64], numbers: Mapping[str, Any]) -> "ShBasis":
        """Read back what `tables` gave."""
        return cls(int(numbers["order"]))

    def reconstruction_matrix(
        self, directions: Float64[F64, "dirs 3"]
    ) -> Float64[F64, "dirs coeffs"]:
        """Tabulate the functions."""
        return eval_sh(self.order, directions)

    def light_from_radiance(
        self,
        directions: Float64[F64, "texels 3"],
        solid_angles: Float64[F64, " texels"],
        radiance: Float64[F64, "texels 3"],
    ) -> Float64[F64, "coeffs 3"]:
        """Project a sampled environment, see `sh_light`."""
        return sh_light(self.order, directions, solid_angles, radiance)
