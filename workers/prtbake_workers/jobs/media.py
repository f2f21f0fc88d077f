"""What scatters inside parts, as requests and files say it, made into dipoles."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from prtbake_storage.contract.materials import Subsurface
from prtbake_workers.transport.dipole import Dipole

DEFAULT_ETA = 1.3
"""Index of refraction of most that the twelve media are: watery."""


def make_dipole(spec: Mapping[str, Any]) -> Dipole:
    """Make the dipole of a `Subsurface` that was dumped as JSON, in units of the scene.

    Three channels that are equal become one.
    """
    subsurface = Subsurface.model_validate(spec)
    unit = subsurface.mm_per_unit
    if subsurface.medium is not None:
        return Dipole.of_material(subsurface.medium, mm_per_unit=unit)
    values = np.array(subsurface.coefficients)
    if (values == values[:, :1]).all():
        values = values[:, :1]
    scattering, absorption = values
    eta = DEFAULT_ETA if subsurface.eta is None else subsurface.eta
    return Dipole.per_millimetre(scattering, absorption, eta=eta, mm_per_unit=unit)
