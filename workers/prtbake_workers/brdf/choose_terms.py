"""How many terms of a factorisation to keep, and the signs that they have."""

import numpy as np

from prtbake_storage.errors import SettingsError
from prtbake_workers.arrays import F64, Float64
from prtbake_workers.brdf.spectrum import Spectrum
from prtbake_workers.percent import percent

DEFAULT_ENERGY_LOST = 0.01
"""Share of the energy that may be lost where neither terms nor an error are asked for."""


def choose_units(
    spectrum: Spectrum, n_terms: int | None, energy_lost: float | None, max_terms: int
) -> tuple[int, str | None]:
    """Choose how many units to keep, with a note where that is not simply what was asked."""
    if energy_lost is None and n_terms is not None:
        units = spectrum.units_for_terms(n_terms)
        kept = int(spectrum.whole_counts[units - 1])
        if kept == n_terms:
            return units, None
        if units == spectrum.usable:
            return units, f"the BRDF has {kept} terms on this grid, {n_terms} were asked for"
        return units, f"{n_terms} terms would split a pair: {kept} are kept"

    asked = DEFAULT_ENERGY_LOST if energy_lost is None else energy_lost
    limit = max_terms if n_terms is None else n_terms
    affordable = spectrum.units_for_terms(limit)
    serving = spectrum.units_for_energy(asked)
    if serving is not None and serving <= affordable:
        return serving, None
    kept = int(spectrum.whole_counts[affordable - 1])
    left = float(spectrum.energies_left[affordable - 1])
    needed = "no number of terms" if serving is None else f"{spectrum.whole_counts[serving - 1]}"
    message = (
        f"{kept} terms (of at most {limit}) leave {percent(left)} of the BRDF's energy, "
        f"more than {percent(asked)}, which takes {needed}"
    )
    if energy_lost is not None:
        raise SettingsError(message)
    return affordable, message


def signs(phi: Float64[F64, "theta units channels"]) -> Float64[F64, " units"]:
    """Sign that makes the largest value of each unit positive."""
    flat = phi.transpose(1, 0, 2).reshape(phi.shape[1], -1)
    peak = np.abs(flat).argmax(axis=1)
    return np.where(flat[np.arange(len(flat)), peak] < 0.0, -1.0, 1.0)
