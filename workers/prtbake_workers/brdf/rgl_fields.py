"""BRDFs out of the fields of a tensor file of the EPFL material database."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import BrdfError
from prtbake_workers.arrays import F32
from prtbake_workers.brdf.rgl import RglTensor
from prtbake_workers.brdf.rgl_oriented import OrientedRglTensor

FIELDS: Mapping[str, int] = {"theta_i": 1, "phi_i": 1, "sigma": 2, "ndf": 2, "vndf": 4, "rgb": 5}
"""Fields that evaluation needs, with their numbers of axes."""


def rgl_from_tensors(
    fields: Mapping[str, NDArray[Any]],
) -> tuple[RglTensor | OrientedRglTensor, dict[str, Any]]:
    """Take a BRDF out of the fields of an RGB tensor file; tell what was found.

    It is anisotropic where light came from more than two azimuths.

    Raises
    ------
    BrdfError
        A field is missing, does not fit the others, or holds NaN; or the file is spectral, its
        values have not been divided by the Jacobian, or its azimuths are not as `OrientedRglTensor`
        takes them.
    """
    missing = [name for name in FIELDS if name not in fields]
    if missing == ["rgb"] and "spectra" in fields:
        raise BrdfError("the file holds spectra: give the RGB version of the material (_rgb.bsdf)")
    if missing:
        raise BrdfError(f"the tensor file lacks {', '.join(missing)}")
    for name, axes in FIELDS.items():
        _check_field(name, fields[name], axes)
    n_azimuths, n_lights = len(fields["phi_i"]), len(fields["theta_i"])
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
    oriented = n_azimuths > 2
    # of an isotropic file the azimuths, two at most, are repetitions
    sigma, vndf, rgb = (
        _plain(fields[name] if oriented else fields[name].mean(axis=0))
        for name in ("sigma", "vndf", "rgb")
    )
    # a real file's noise dips below 0 by a little
    colours = np.ascontiguousarray(np.moveaxis(np.maximum(rgb, 0.0), -3, -1))
    theta_i, ndf = _plain(fields["theta_i"]), _plain(fields["ndf"])
    report = {
        "n_lights": n_lights,
        "resolution": list(rgb.shape[-2:]),
        "n_negative": int((rgb < 0.0).sum()),
        "most_negative": min(0.0, float(rgb.min())),
        "largest": float(rgb.max()),
    }
    if not oriented:
        return RglTensor(theta_i=theta_i, sigma=sigma, ndf=ndf, vndf=vndf, rgb=colours), report
    tensor = OrientedRglTensor(
        phi_i=_plain(fields["phi_i"]),
        theta_i=theta_i,
        sigma=sigma,
        ndf=ndf,
        vndf=vndf,
        rgb=colours,
    )
    return tensor, report | {"n_azimuths": n_azimuths, "reduction": tensor.reduction}


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


def _plain(array: NDArray[Any]) -> F32:
    return np.ascontiguousarray(array, dtype=np.float32)
