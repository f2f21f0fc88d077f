"""The sum of products of an isotropic BRDF whose view side is in hemispherical harmonics."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from prtbake_storage.decode.sh import eval_sh
from prtbake_workers.arrays import F64, I32, Float64, Int32
from prtbake_workers.brdf.azimuthal_factorisation import AzimuthalFactorisation
from prtbake_workers.brdf.base import COSINE_FLOOR, Brdf
from prtbake_workers.brdf.hemisphere_grid import azimuthal_blocks, norm_of_order

VIEW_RINGS = 64
"""Gauss rings over the views that a fit is taken at: exact for functions of degree 127."""


@dataclass(frozen=True, eq=False, kw_only=True)
class HarmonicFactorisation(AzimuthalFactorisation):
    """Least-squares optimal projection of a BRDF's views on hemispherical harmonics.

    ``rho(wi, wo) ~ sum_lm c_lm(wi) y_lm(wo)`` with the c that minimise the squared error over the
    hemisphere of views for every wi: rows of A^-1 B, [Sloan2003]_ eq. (1) and 9.1, not projected on
    the side of the light.  The same sum is written in phi that are orthonormal under the view's
    cosine and psi that are orthogonal, as in every factorisation; each is a combination of
    harmonics, or of their coefficients.

    Attributes
    ----------
    functions
        Indices l (l + 1) + m of the harmonics of m >= 0, rising; each stands for +-m.
    view_coefficients
        Of the radial functions of phi in the y_lm, all degrees below the order; 0 where l < m.
    light_coefficients
        Those that make psi of the c_lm.

    References
    ----------
    .. [Sloan2003] P.-P. Sloan, J. Hall, J. Hart, J. Snyder, "Clustered Principal Components for
       Precomputed Radiance Transfer", 2003.
    """

    TABLE_ARRAYS: ClassVar[tuple[str, ...]] = (
        *AzimuthalFactorisation.TABLE_ARRAYS,
        "functions",
        "view_coefficients",
        "light_coefficients",
    )
    CHANNELS_OF_PHI: ClassVar[tuple[str, ...]] = (
        *AzimuthalFactorisation.CHANNELS_OF_PHI,
        "view_coefficients",
    )

    functions: Int32[I32, " functions"]
    view_coefficients: Float64[F64, "degrees units channels"]
    light_coefficients: Float64[F64, "degrees units colours"]

    @property
    def view_order(self) -> int:
        """Bands n of the views."""
        return len(self.view_coefficients)

    def radial_exact(
        self, cosines: Float64[F64, " n"], *, light_side: bool
    ) -> Float64[F64, "n units columns"]:
        """Evaluate the radial functions without a table.

        phi is a polynomial in cosine and sine; psi is fitted to the BRDF, which it takes.

        Parameters
        ----------
        cosines
            Where; at most `base.COSINE_FLOOR` counts as the horizon's limit from above.
        light_side
            psi with one column, or phi with a column a channel.
        """
        at = np.maximum(cosines, COSINE_FLOOR)
        orders = self.orders[self.parity == 0]
        if not light_side:
            harmonics = radial_harmonics(self.view_order, at)[orders]
            radial: F64 = np.einsum("knl,lkc->nkc", harmonics, self.view_coefficients)
            return radial
        if self.brdf is None:
            raise ValueError("the light side needs the BRDF, which this factorisation lacks")
        fitted = fitted_views(
            self.brdf, at, self.view_order, self.functions, n_phi=self.grid.n_phi
        )[orders]
        psi: F64 = np.einsum("knlc,lkc->nk", fitted, self.light_coefficients)
        return psi[..., None]


def degrees_of(m: int, order: int, functions: Int32[I32, " functions"]) -> list[int]:
    """List the degrees of the harmonics of azimuthal order m among those chosen."""
    return [degree for degree in range(m, order) if degree * (degree + 1) + m in functions]


def radial_harmonics(order: int, cosines: Float64[F64, " n"]) -> Float64[F64, "orders n degrees"]:
    """Evaluate the radial functions of y_lm: what multiplies cos(m phi) and sin(m phi).

    Returns
    -------
    ndarray
        Of m = 0 ... order - 1 and l = 0 ... order - 1; 0 where l < m.
    """
    meridian = np.stack([np.sqrt(1.0 - cosines**2), np.zeros_like(cosines), cosines], axis=1)
    values = eval_sh(order, meridian)
    radial = np.zeros((order, len(cosines), order))
    for m in range(order):
        degrees = np.arange(m, order)
        radial[m][:, degrees] = values[:, degrees * (degrees + 1) + m]
    return radial


def fitted_views(
    brdf: Brdf,
    cosines: Float64[F64, " n"],
    order: int,
    functions: Int32[I32, " functions"],
    *,
    n_phi: int,
) -> Float64[F64, "orders n degrees channels"]:
    """Fit hemispherical harmonics to the views of a BRDF: the c_lm of light from azimuth 0.

    For every order m the least squares over rings of views, which is that over the hemisphere:
    waves of different m are orthogonal on it.

    Parameters
    ----------
    brdf
        Isotropic.
    cosines
        Of the light.
    order, functions
        Which harmonics, see `HarmonicFactorisation`; the others get 0.
    n_phi
        Azimuths that the BRDF's Fourier coefficients are taken from.
    """
    node, weight = np.polynomial.legendre.leggauss(VIEW_RINGS)
    rings, roots = 0.5 * (node + 1.0), np.sqrt(0.5 * weight)
    blocks = azimuthal_blocks(brdf, cosines, rings, n_phi, n_orders=order)
    norm = norm_of_order(np.arange(order, dtype=np.int32))
    harmonics = radial_harmonics(order, rings)
    fitted = np.zeros((order, len(cosines), order, brdf.n_channels))
    for m in range(order):
        degrees = degrees_of(m, order, functions)
        if not degrees:
            continue
        solved = np.linalg.pinv(roots[:, None] * harmonics[m][:, degrees]) * roots
        fitted[m][:, degrees] = np.einsum("lo,noc->nlc", solved, blocks[m] / norm[m])
    return fitted
