"""How many pieces the texels of a map are cut into, to integrate functions finer than they are."""

from math import ceil, pi, sqrt

from prtbake_storage.contract.settings import BakeSettings
from prtbake_workers.basis.srbf import default_bandwidth


def cut_texels(n_texels: int, finest_rad: float) -> int:
    """Count what `subdivided_texels` cuts a map of twice as many columns as rows into."""
    times = max(1, ceil(pi / sqrt(n_texels / 2) / finest_rad))
    return n_texels * times**2


def spacing_of(bake: BakeSettings, n_coeffs: int) -> float:
    """Give the angle between samples of light that resolve a bake's basis.

    See ``spacing_rad`` of `prtbake_storage.decode.transfer_basis`.
    """
    if bake.sh_order is not None:
        return pi / (8.0 * bake.sh_order)
    return 0.25 / sqrt(bake.bandwidth or default_bandwidth(n_coeffs))
