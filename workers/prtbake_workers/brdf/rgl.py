"""Measured BRDFs of the EPFL material database, in their adaptive parametrisation."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.brdf.base import above_horizon, clamped_cosines
from prtbake_workers.brdf.bilinear_warp import BilinearWarp, look_up, slices_at

FIELDS: Mapping[str, int] = {"theta_i": 1, "phi_i": 1, "sigma": 2, "ndf": 2, "vndf": 4, "rgb": 5}
"""Fields that evaluation needs, with their numbers of axes."""

SIGMA_FLOOR = 1e-9
"""Smallest projected area that is divided by; a surface's own is at least the cosine."""

CHUNK = 8192
"""Pairs of directions a pass: their dozens of temporaries then fit the cache."""


@dataclass(frozen=True, eq=False)
class RglTensor:
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
            _check_not_negative(name, getattr(self, name))
        object.__setattr__(self, "_warp", BilinearWarp(self.vndf))

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

    def _reflected(
        self, light: Float64[F64, "n 3"], view: Float64[F64, "n 3"]
    ) -> Float64[F64, "n 3"]:
        """Evaluate with the cosine of the view."""
        theta_i, phi_i = _spherical(light)
        theta_m, phi_m = _spherical(light + view)
        x = _unit_polar(theta_m)
        y = (phi_m - phi_i) / (2.0 * np.pi) + 0.5
        y -= np.floor(y)
        slices = slices_at(self.theta_i.astype(np.float64), theta_i)
        value = look_up(self.rgb, slices, *self._warp.invert(slices, x, y))
        value *= look_up(self.ndf[None, :, :, None], slices_at(np.zeros(1), x), x, y)
        area = np.interp(_unit_polar(theta_i), np.linspace(0.0, 1.0, len(self.sigma)), self.sigma)
        return value / (4.0 * np.maximum(area, SIGMA_FLOOR)[:, None])


def rgl_from_tensors(fields: Mapping[str, NDArray[Any]]) -> tuple[RglTensor, dict[str, Any]]:
    """Take an isotropic BRDF out of the fields of an RGB tensor file; tell what was found.

    Raises
    ------
    BrdfError
        A field is missing, does not fit the others, or holds NaN; or the file is anisotropic, or
        spectral, or its values have not been divided by the Jacobian.
    """
    missing = [name for name in FIELDS if name not in fields]
    if missing == ["rgb"] and "spectra" in fields:
        raise BrdfError("the file holds spectra: give the RGB version of the material (_rgb.bsdf)")
    if missing:
        raise BrdfError(f"the tensor file lacks {', '.join(missing)}")
    for name, axes in FIELDS.items():
        _check_field(name, fields[name], axes)
    n_azimuths, n_lights = len(fields["phi_i"]), len(fields["theta_i"])
    if n_azimuths > 2:
        raise BrdfError(
            f"the material is anisotropic ({n_azimuths} azimuths of light): only isotropic tensor "
            "files are read"
        )
    for name in ("vndf", "rgb"):
        if fields[name].shape[:2] != (n_azimuths, n_lights):
            raise BrdfError(
                f"field {name!r} has shape {fields[name].shape} beside {n_azimuths} azimuths and "
                f"{n_lights} angles of light"
            )
    if fields["rgb"].shape[2] != 3:
        raise BrdfError(f"field 'rgb' has {fields['rgb'].shape[2]} channels, not 3")
    if (np.diff(fields["theta_i"]) <= 0.0).any():
        raise BrdfError("field 'theta_i' does not rise")
    if "jacobian" not in fields or fields["jacobian"].size != 1 or not fields["jacobian"].all():
        raise BrdfError("field 'jacobian' is not 1: values that include it are not read")
    rgb = _plain(fields["rgb"].mean(axis=0))
    tensor = RglTensor(
        theta_i=_plain(fields["theta_i"]),
        sigma=_plain(fields["sigma"].mean(axis=0)),
        ndf=_plain(fields["ndf"]),
        vndf=_plain(fields["vndf"].mean(axis=0)),
        # a real file's noise dips below 0 by a little
        rgb=np.ascontiguousarray(np.moveaxis(np.maximum(rgb, 0.0), 1, -1)),
    )
    report = {
        "n_lights": n_lights,
        "resolution": list(rgb.shape[2:]),
        "n_negative": int((rgb < 0.0).sum()),
        "most_negative": min(0.0, float(rgb.min())),
        "largest": float(rgb.max()),
    }
    return tensor, report


def _check_field(name: str, array: NDArray[Any], axes: int) -> None:
    if array.ndim != axes or array.dtype.kind != "f":
        raise BrdfError(
            f"field {name!r} is {array.dtype} of shape {array.shape}, not float with {axes} axes"
        )
    # sigma of an isotropic material needs no second row
    square = array.shape[-1:] if name == "sigma" else array.shape[-2:]
    if not array.size or (axes > 1 and min(square) < 2):
        raise BrdfError(f"field {name!r} of shape {array.shape} is too small to interpolate in")
    if not np.isfinite(array).all():
        place = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise BrdfError(f"field {name!r} is not finite at {place}")


def _check_not_negative(name: str, array: NDArray[Any]) -> None:
    if not (np.isfinite(array).all() and (array >= 0.0).all()):
        raise BrdfError(f"{name} holds negative values or NaN")


def _plain(array: NDArray[Any]) -> F32:
    return np.ascontiguousarray(array, dtype=np.float32)


def _spherical(w: Float64[F64, "n 3"]) -> tuple[Float64[F64, " n"], Float64[F64, " n"]]:
    x, y, z = w.T
    return np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)


def _unit_polar(theta: Float64[F64, " n"]) -> Float64[F64, " n"]:
    return np.sqrt(np.clip(theta * (2.0 / np.pi), 0.0, 1.0))
