"""Files of kind ``light``: an environment as lobes, spherical harmonics or wavelets.

Attribute ``method`` is ``srbf_uniform``, ``sh`` or ``wavelet``.  Without it the light is a sum of
scattered SRBFs: files of these never carried it.
"""

from pathlib import Path
from typing import Any

import h5py
import numpy as np

from prtbake_storage.decode.light import FittedLight, HarmonicLight, LightFit, WaveletLight
from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5
from prtbake_storage.hdf5.resources import check_unit


def write_light(path: Path, light: FittedLight) -> None:
    """Write a fitted light."""
    with h5.new_file(path, "light") as file:
        group = h5.group(file, "light")
        if light.method != "srbf_scattered":
            h5.set_attribute(group, "method", light.method)
        match light:
            case LightFit():
                h5.set_attribute(group, "kernel", "gaussian")
                h5.set_attribute(group, "error", float(light.error))
                h5.put(group, "centres", light.centres, "lobes xyz")
                h5.put(group, "bandwidths", light.bandwidths, "lobes")
                axis = "lobes"
            case HarmonicLight():
                h5.set_attribute(group, "error", float(light.error))
                axis = "harmonics"
            case WaveletLight():
                h5.set_attribute(group, "error", float(light.error))
                h5.set_attribute(group, "resolution", int(light.resolution))
                h5.put(group, "indices", light.indices.astype(np.int32), "wavelets")
                axis = "wavelets"
        h5.put(group, "coefficients", light.coefficients, f"{axis} channels", unit="radiance")
        h5.put_json(file, "provenance", dict(light.provenance))


def read_light(path: Path) -> FittedLight:
    """Read a fitted light.

    Raises
    ------
    CorruptArtefact
        Naming what is damaged, missing or not of the light's method.
    """
    with h5.open_file(path, "light") as file:
        group = h5.child(file, "light")
        method = h5.attribute(group, "method") if h5.has_attribute(group, "method") else None
        common: dict[str, Any] = {
            "error": _number(group, "error"),
            "provenance": h5.get_object(file, "provenance"),
        }
        light: FittedLight
        match method:
            case None:
                light = _lobes(group, method="srbf_scattered", **common)
            case "srbf_uniform":
                light = _lobes(group, method="srbf_uniform", **common)
            case "sh":
                light = HarmonicLight(coefficients=_coefficients(group, None), **common)
            case "wavelet":
                light = _wavelets(group, **common)
            case _:
                raise CorruptArtefact(f"/light: method is {method!r}")
    try:
        light.check()
    except ValueError as error:
        raise CorruptArtefact(f"/light/{error}") from error
    return light


def _lobes(group: h5py.Group, **common: Any) -> LightFit:
    centres = h5.get(group, "centres", "f", (None, 3)).astype(np.float64)
    bandwidths = h5.get(group, "bandwidths", "f", (len(centres),)).astype(np.float64)
    check_unit("/light/centres", centres)
    return LightFit(
        centres=centres,
        bandwidths=bandwidths,
        coefficients=_coefficients(group, len(centres)),
        **common,
    )


def _wavelets(group: h5py.Group, **common: Any) -> WaveletLight:
    resolution = h5.attribute(group, "resolution")
    if not isinstance(resolution, int):
        raise CorruptArtefact(f"/light/resolution is {resolution!r}, not a number of texels")
    indices = h5.get_int32(group, "indices", (None,))
    return WaveletLight(
        resolution=resolution,
        indices=indices,
        coefficients=_coefficients(group, len(indices)),
        **common,
    )


def _coefficients(group: h5py.Group, count: int | None) -> np.ndarray[Any, np.dtype[np.float64]]:
    return h5.get(group, "coefficients", "f", (count, 3)).astype(np.float64)


def _number(group: h5py.Group, name: str) -> float:
    value = h5.attribute(group, name)
    if not isinstance(value, int | float) or not 0.0 <= value < np.inf:
        raise CorruptArtefact(f"/light/{name} is {value!r}, not a number of at least 0")
    return float(value)
