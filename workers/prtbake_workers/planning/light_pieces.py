"""How many pieces the texels of a map are cut into, to integrate functions finer than they are."""

from dataclasses import dataclass
from math import ceil, pi, sqrt

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import BakeSettings
from prtbake_storage.decode.transfer_basis import SphericalHarmonics
from prtbake_workers.basis.srbf import default_bandwidth
from prtbake_workers.environment.subdivision import COARSEST_RAD
from prtbake_workers.environment.uniform_srbf import chosen_bandwidth
from prtbake_workers.environment.wavelet_projection import finest_of_wavelets


def cut_texels(n_texels: int, finest_rad: float) -> int:
    """Count what `subdivided_texels` cuts a map of twice as many columns as rows into."""
    times = max(1, ceil(pi / sqrt(n_texels / 2) / finest_rad))
    return n_texels * times**2


@dataclass(frozen=True)
class FitSamples:
    """How many samples of a map a fit of scattered lobes moves, solves and judges them in.

    Bright texels are split: a map of many lamps has many times its texels.
    """

    moving: int
    solving: int
    judging: int

    @classmethod
    def unsplit(cls, n_texels: int) -> "FitSamples":
        """Take no texel of a map to be split."""
        return cls(n_texels, n_texels, n_texels)


def projected_pieces(settings: FitLightSettings, n_texels: int) -> int:
    """Count the pieces that a projection of any other kind integrates a map in."""
    match settings.method:
        case "sh":
            finest = SphericalHarmonics(settings.sh_order or 1).spacing_rad
        case "srbf_uniform":
            width = chosen_bandwidth(settings.n_centres or 12, settings.bandwidth)
            finest = 0.25 / sqrt(width)
        case _:
            finest = finest_of_wavelets(settings.resolution or 8)
    return cut_texels(n_texels, min(finest, COARSEST_RAD))


def spacing_of(bake: BakeSettings, n_coeffs: int) -> float:
    """Give the angle between samples of light that resolve a bake's basis.

    See ``spacing_rad`` of `prtbake_storage.decode.transfer_basis`.
    """
    if bake.sh_order is not None:
        return pi / (8.0 * bake.sh_order)
    return 0.25 / sqrt(bake.bandwidth or default_bandwidth(n_coeffs))
