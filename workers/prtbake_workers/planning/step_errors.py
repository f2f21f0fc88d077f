"""How the lines of an error budget change between two settings of one scene: a prediction.

Nothing is simulated.  The numbers that decide a line are counted for both settings, and the line
is taken to change as a power of their ratio; a line that no setting decides stays as it is.  The
powers were fitted to studies of ``docs/measured/accuracy.md``, which says how well they foretell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from prtbake_storage.contract.light import FitLightSettings
from prtbake_workers.arrays import F64, Float64

POWERS: Mapping[str, tuple[str, float]] = {
    "terms": ("energy_lost", 0.4),
    "visibility": ("directions", -0.27),
    "basis": ("functions", -0.4),
    "light": ("light_functions", -1.0),
    "compression": ("vectors", -0.5),
}
"""Of each kind of line: it goes as this number to this power; bounces hardly changed with rays."""


@dataclass(frozen=True)
class Resolution:
    """The numbers that decide the lines of an error budget; 0 stands for one that decides nothing.

    Attributes
    ----------
    energy_lost
        Share of the BRDFs' energy that their terms leave, summed over parts.
    directions
        Rays a vertex in which visibility is known.
    functions
        Of the basis that transport is projected on.
    light_functions
        Lobes, harmonics or wavelets of the light.
    vectors
        That vertices are mixed of, summed over clusters and parts.
    """

    energy_lost: float
    directions: int
    functions: int
    light_functions: int
    vectors: int


def line_factors(own: Resolution, other: Resolution) -> dict[str, float]:
    """Predict each kind of line at ``other``, over the same line at ``own``.

    A number that is 0 at either decides nothing that could be scaled.
    """
    before, after = asdict(own), asdict(other)
    return {
        kind: float((after[name] / before[name]) ** power)
        if before[name] > 0 and after[name] > 0
        else 1.0
        for kind, (name, power) in POWERS.items()
    }


def energy_left(spectra: Sequence[Float64[F64, " _"]], terms: Sequence[int]) -> float:
    """Sum over parts the share of a BRDF's energy outside so many terms."""
    left = 0.0
    for values, n_terms in zip(spectra, terms, strict=True):
        energy = np.square(values)
        whole = float(energy.sum())
        left += float(energy[n_terms:].sum()) / whole if whole > 0.0 else 0.0
    return left


def light_functions(settings: FitLightSettings) -> int:
    """Count the functions of a light; 0 where they are as many as an error or bytes ask for."""
    if settings.max_error is not None or settings.max_bytes is not None:
        return 0
    match settings.method:
        case "srbf_scattered":
            return settings.n_lobes or 0
        case "srbf_uniform":
            return settings.n_centres or 0
        case "sh":
            return (settings.sh_order or 0) ** 2
        case "wavelet":
            return settings.n_wavelets or 0


def scaled_total(
    total: float, lines: Mapping[str, float], factors: Mapping[str, float]
) -> tuple[float, dict[str, float]]:
    """Predict the total and the lines of a budget whose lines are multiplied by factors.

    The total keeps its ratio to the root of the lines' sum of squares: how far lines cancel is
    taken to stay.

    Parameters
    ----------
    total, lines
        As measured: relative L2.
    factors
        Of lines, by name; 1 for those not named.
    """
    scaled = {name: error * factors.get(name, 1.0) for name, error in lines.items()}
    before = sum(error**2 for error in lines.values())
    after = sum(error**2 for error in scaled.values())
    return (total * float(np.sqrt(after / before)) if before > 0.0 else total), scaled
