"""Canonical files of measured BRDFs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.errors import CorruptArtefact
from prtbake_storage.hdf5 import primitives as h5

AXES: Mapping[str, Mapping[str, str]] = {
    "half_difference": {"values": "theta_h theta_d phi_d channels"},
    "rgl": {
        "theta_i": "lights",
        "sigma": "angles",
        "ndf": "rows columns",
        "vndf": "lights rows columns",
        "rgb": "lights up along channels",
    },
    "rgl_oriented": {
        "phi_i": "azimuths",
        "theta_i": "lights",
        "sigma": "lines angles",
        "ndf": "rows columns",
        "vndf": "azimuths lights rows columns",
        "rgb": "azimuths lights up along channels",
    },
}
"""Arrays of each parametrisation, with the names of their axes."""


@dataclass(frozen=True)
class BrdfFile:
    """The arrays of a measured BRDF; ``report`` is what reading the upload found and mended."""

    parametrisation: str
    arrays: Mapping[str, NDArray[Any]]
    report: Mapping[str, Any] = field(default_factory=dict)


def write_brdf(path: Path, brdf: BrdfFile) -> None:
    """Write the canonical file of a measured BRDF."""
    with h5.new_file(path, "brdf") as file:
        group = h5.group(file, "brdf")
        h5.set_attribute(group, "parametrisation", brdf.parametrisation)
        for name, axes in AXES[brdf.parametrisation].items():
            h5.put(group, name, np.asarray(brdf.arrays[name]), axes)
        h5.put_json(file, "provenance", dict(brdf.report))


def read_brdf(path: Path) -> BrdfFile:
    """Read the canonical file of a measured BRDF; arrays come back as they were written.

    Raises
    ------
    CorruptArtefact
        Naming the dataset that is damaged, missing or not what the schema says.
    """
    with h5.open_file(path, "brdf") as file:
        group = h5.child(file, "brdf")
        parametrisation = h5.attribute(group, "parametrisation")
        if parametrisation not in AXES:
            raise CorruptArtefact(f"/brdf: no parametrisation {parametrisation!r} is known")
        arrays = {
            name: h5.get(group, name, "f", (None,) * len(axes.split()))
            for name, axes in AXES[parametrisation].items()
        }
        return BrdfFile(parametrisation, arrays, h5.get_object(file, "provenance"))
