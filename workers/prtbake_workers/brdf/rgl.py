"""Measured BRDFs of the EPFL material database, in their adaptive parametrisation."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.brdf.base import above_horizon, clamped_cosines
from prtbake_workers.brdf.bilinear_warp import BilinearWarp, look_up, slices_at

SIGMA_FLOOR = 1e-9
"""Smallest projected area that is divided by; a surface's own is at least the cosine."""

CHUNK = 8192
"""Pairs of directions a pass: their dozens of temporaries then fit the cache."""


class ChunkedTensor(ABC):
    """A measured BRDF that is known with the cosine of the view, for rows of pairs."""

    @property
    def n_channels(self) -> int:
        """Three: linear Rec.709."""
        return 3

    def eval_brdf(
        self, wi: Float64[F64, "... 3"], wo: Float64[F64, "... 3"]
    ) -> Float64[F64, "... channels"]:
        """Evaluate in 1/sr; 0 below the horizon."""
        above = above_horizon(wi, wo)
        _, cos_o = clamped_cosines(wi, wo)
        light, view = (side.reshape(-1, 3) for side in np.broadcast_arrays(wi, wo))
        value = np.zeros((len(light), 3))
        for start in range(0, len(light), CHUNK):
            rows = slice(start, start + CHUNK)
            value[rows] = self._reflected(light[rows], view[rows])
        value = value.reshape(*above.shape, 3) / cos_o[..., None]
        value[~above] = 0.0
        return value

    @abstractmethod
    def _reflected(
        self, light: Float64[F64, "n 3"], view: Float64[F64, "n 3"]
    ) -> Float64[F64, "n 3"]:
        """Evaluate with the cosine of the view."""


@dataclass(frozen=True, eq=False)
class RglTensor(ChunkedTensor):
    """``rgb(s) ndf(u_m) / (4 sigma(theta_i) cos_o)`` [Dupuy2018]_, one channel a colour.

    u_m are the half vector's angles on the unit square, ``(sqrt(2 theta_m / pi),
    (phi_m - phi_i + pi) / 2 pi)``; s is where the density of visible normals ``vndf`` puts u_m, as
    cumulative probabilities.

    Attributes
    ----------
    theta_i
        Angles of light that were measured, rising, in radians.
    sigma
        Projected area of the facets over sqrt(2 theta / pi) in equal steps.
    ndf
        Density of the facets' normals over the unit square of u_m (columns: theta).
    vndf
        Density of those that the light sees, by theta_i.
    rgb
        Measured values over s (columns: along theta), by theta_i; linear Rec.709.

    Notes
    -----
    Isotropic, but neither reciprocal nor mirror-symmetric: `symmetrised.Symmetrised` makes it so.

    References
    ----------
    .. [Dupuy2018] J. Dupuy, W. Jakob, "An Adaptive Parameterization for Efficient Material
       Acquisition and Rendering", 2018.
    """

    theta_i: Float32[F32, " lights"]
    sigma: Float32[F32, " angles"]
    ndf: Float32[F32, "rows columns"]
    vndf: Float32[F32, "lights rows columns"]
    rgb: Float32[F32, "lights up along 3"]
    _warp: BilinearWarp = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("sigma", "ndf", "vndf", "rgb"):
            check_not_negative(name, getattr(self, name))
        check_facets_seen(self.vndf, self.theta_i)
        object.__setattr__(self, "_warp", BilinearWarp(self.vndf))

    def _reflected(
        self, light: Float64[F64, "n 3"], view: Float64[F64, "n 3"]
    ) -> Float64[F64, "n 3"]:
        """Evaluate with the cosine of the view."""
        theta_i, phi_i = spherical(light)
        theta_m, phi_m = spherical(light + view)
        x = unit_polar(theta_m)
        y = (phi_m - phi_i) / (2.0 * np.pi) + 0.5
        y -= np.floor(y)
        slices = slices_at(self.theta_i.astype(np.float64), theta_i)
        value = look_up(self.rgb, slices, *self._warp.invert(slices, x, y))
        value *= look_up(self.ndf[None, :, :, None], slices_at(np.zeros(1), x), x, y)
        area = np.interp(unit_polar(theta_i), np.linspace(0.0, 1.0, len(self.sigma)), self.sigma)
        return value / (4.0 * np.maximum(area, SIGMA_FLOOR)[:, None])


def check_not_negative(name: str, array: NDArray[Any]) -> None:
    """Refuse a table that no density or measurement has."""
    if not (np.isfinite(array).all() and (array >= 0.0).all()):
        raise BrdfError(f"{name} holds negative values or NaN")


def check_facets_seen(
    vndf: Float32[F32, "... lights rows columns"],
    theta_i: Float32[F32, " lights"],
    phi_i: Float32[F32, " azimuths"] | None = None,
) -> None:
    """Refuse densities that are zero everywhere for some light: nothing is distributed by them."""
    unseen = np.argwhere(~vndf.any(axis=(-2, -1)))
    if len(unseen):
        at = unseen[0]
        azimuth = "" if phi_i is None else f"phi_i {np.rad2deg(phi_i[at[0]]):.4g} and "
        raise BrdfError(
            f"field 'vndf' is zero everywhere for light at {azimuth}theta_i "
            f"{np.rad2deg(theta_i[at[-1]]):.4g} degrees"
        )


def spherical(w: Float64[F64, "n 3"]) -> tuple[Float64[F64, " n"], Float64[F64, " n"]]:
    """Give theta and phi in (-pi, pi], and -pi where y is -0."""
    x, y, z = w.T
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)


def unit_polar(theta: Float64[F64, " n"]) -> Float64[F64, " n"]:
    """Give the place of a polar angle on the unit square."""
    return np.sqrt(np.clip(theta * (2.0 / np.pi), 0.0, 1.0))
