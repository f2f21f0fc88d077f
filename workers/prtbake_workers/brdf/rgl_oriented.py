"""Measured anisotropic BRDFs of the EPFL material database."""

from dataclasses import dataclass, field

import numpy as np

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import B8, F32, F64, Bool, Float32, Float64
from prtbake_workers.brdf.bilinear_warp import (
    BilinearWarp,
    Blend,
    look_up,
    slices_around,
    slices_at,
    slices_of_both,
)
from prtbake_workers.brdf.rgl import (
    SIGMA_FLOOR,
    ChunkedTensor,
    check_facets_seen,
    check_not_negative,
    spherical,
    unit_polar,
)

REDUCTIONS = (1, 2, 4)
"""Parts of a turn that the measured azimuths may be one of: by no symmetry, by that of half a turn,
and by both mirrors."""

AZIMUTH_SLACK = 1e-4
"""Radians by which azimuths in float32 may miss an end."""


@dataclass(frozen=True, eq=False)
class OrientedRglTensor(ChunkedTensor):
    """``rgb(s) ndf(u_m) / (4 sigma(u_i) cos_o)`` [Dupuy2018]_, by the light's angle and azimuth.

    As `RglTensor`, but that azimuths are those of the surface: u_m is ``(sqrt(2 theta_m / pi),
    (phi_m + pi) / 2 pi)``, u_i the same of the light.

    Attributes
    ----------
    phi_i
        Azimuths of light that were measured, rising from -pi over a whole, half or quarter turn.
        At the ends half a step may lack; of a whole turn its end, which is its beginning.
    theta_i
        Angles of light that were measured, rising, in radians.
    sigma
        Projected area of the facets over the unit square of u_i (columns: theta).
    ndf
        Density of the facets' normals over the unit square of u_m.
    vndf
        Density of those that the light sees.
    rgb
        Measured values over s (columns: along theta); linear Rec.709.

    Raises
    ------
    BrdfError
        A table is negative somewhere, or the azimuths span no whole, half or quarter turn from -pi.

    Notes
    -----
    Over half a turn the other half is the same, turned by 180 degrees; over a quarter the others
    are its mirror images.  Neither reciprocal nor, of more than a quarter, mirror-symmetric:
    `symmetrised.SymmetrisedOriented` makes it so.

    References
    ----------
    .. [Dupuy2018] J. Dupuy, W. Jakob, "An Adaptive Parameterization for Efficient Material
       Acquisition and Rendering", 2018.
    """

    phi_i: Float32[F32, " azimuths"]
    theta_i: Float32[F32, " lights"]
    sigma: Float32[F32, "lines angles"]
    ndf: Float32[F32, "rows columns"]
    vndf: Float32[F32, "azimuths lights rows columns"]
    rgb: Float32[F32, "azimuths lights up along 3"]
    reduction: int = field(init=False)
    _warp: BilinearWarp = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("sigma", "ndf", "vndf", "rgb"):
            check_not_negative(name, getattr(self, name))
        object.__setattr__(self, "reduction", _reduction(self.phi_i.astype(np.float64)))
        check_facets_seen(self.vndf, self.theta_i, self.phi_i)
        flat = self.vndf.reshape(-1, *self.vndf.shape[2:])
        object.__setattr__(self, "_warp", BilinearWarp(flat))

    @property
    def mirror_images(self) -> int:
        """How many of the mirror images of `SymmetrisedOriented` differ from each other."""
        return 4 // self.reduction

    @property
    def is_isotropic(self) -> bool:
        """No: it was measured from several azimuths."""
        return False

    def _reflected(
        self, light: Float64[F64, "n 3"], view: Float64[F64, "n 3"]
    ) -> Float64[F64, "n 3"]:
        """Evaluate with the cosine of the view."""
        light, view = _folded(light, view, self.reduction)
        theta_i, phi_i = spherical(light)
        theta_m, phi_m = spherical(light + view)
        x, y = unit_polar(theta_m), _unit_azimuth(phi_m)
        slices = slices_of_both(
            self._azimuths_at(phi_i),
            slices_at(self.theta_i.astype(np.float64), theta_i),
            len(self.theta_i),
        )
        rgb = self.rgb.reshape(-1, *self.rgb.shape[2:])
        value = look_up(rgb, slices, *self._warp.invert(slices, x, y))
        whole = slices_at(np.zeros(1), x)
        value *= look_up(self.ndf[None, :, :, None], whole, x, y)
        area = look_up(
            self.sigma[None, :, :, None], whole, unit_polar(theta_i), _unit_azimuth(phi_i)
        )
        return value / (4.0 * np.maximum(area, SIGMA_FLOOR))

    def _azimuths_at(self, phi: Float64[F64, " n"]) -> Blend:
        """Mix the azimuths beside the light's: around the turn, where the whole was measured."""
        nodes = self.phi_i.astype(np.float64)
        if self.reduction == 1 and 2.0 * np.pi - (nodes[-1] - nodes[0]) > AZIMUTH_SLACK:
            return slices_around(nodes, phi, 2.0 * np.pi)
        return slices_at(nodes, phi)


def _reduction(phi_i: Float64[F64, " azimuths"]) -> int:
    """Tell which part of a turn the azimuths span, [Dupuy2018]_'s reduction by symmetry."""
    rising = len(phi_i) > 2 and bool((np.diff(phi_i) > 0.0).all())
    if not rising:
        raise BrdfError("field 'phi_i' does not rise over three azimuths or more")
    step = float(np.diff(phi_i).max())
    first, last = float(phi_i[0]) + np.pi, float(phi_i[-1]) + np.pi
    # beyond an end its slice is held, no farther than another would be; none lies beyond the end
    for reduction in reversed(REDUCTIONS):
        part = 2.0 * np.pi / reduction
        # around a whole turn the last azimuth and the first are neighbours
        missing, allowed = (
            (part - last, 0.5 * step) if reduction > 1 else (part - last + first, step)
        )
        if (
            -AZIMUTH_SLACK <= first <= 0.5 * step + AZIMUTH_SLACK
            and last <= part + AZIMUTH_SLACK
            and missing <= allowed + AZIMUTH_SLACK
        ):
            return reduction
    raise BrdfError(
        f"field 'phi_i' runs from {phi_i[0]:.3g} to {phi_i[-1]:.3g}: not over a whole, half or "
        "quarter turn from -pi"
    )


def _folded(
    light: Float64[F64, "n 3"], view: Float64[F64, "n 3"], reduction: int
) -> tuple[Float64[F64, "n 3"], Float64[F64, "n 3"]]:
    """Bring the light to the measured azimuths, by the symmetries that leave the BRDF as it is.

    Where the light lies in the mirror, or on the axis, the view decides.
    """
    if reduction == 1:
        return light, view
    sign = np.ones(light.shape)
    if reduction == 2:
        sign[_is_positive(light[:, 1], view[:, 1]), :2] = -1.0
    else:
        for axis in range(2):
            sign[_is_positive(light[:, axis], view[:, axis]), axis] = -1.0
    light, view = light * sign, view * sign
    # what is zero becomes -0: then atan2 gives -pi, not pi
    for axis in range(1 if reduction == 2 else 0, 2):
        light[:, axis] = -np.abs(light[:, axis])
    return light, view


def _is_positive(light: Float64[F64, " n"], view: Float64[F64, " n"]) -> Bool[B8, " n"]:
    return np.asarray((light > 0.0) | ((light == 0.0) & (view > 0.0)))


def _unit_azimuth(phi: Float64[F64, " n"]) -> Float64[F64, " n"]:
    return phi / (2.0 * np.pi) + 0.5
