"""What a block of bounced coefficients holds: its transfer, its rays, its rows of scattering."""

from collections.abc import Sequence

from prtbake_workers.planning.cost import CHILD_BYTES
from prtbake_workers.transport.separable_bounce import VERTICES_PER_PRODUCT

TRANSFERS = 3
"""Channels of transfer held at once: the sum, what was sent, what arrives; what leaves takes the
place of the latter, a part at a time."""


def bounce_memory_bytes(
    n_verts: Sequence[int],
    part_terms: Sequence[int],
    *,
    n_rays: Sequence[int],
    hit_share: float,
    n_channels: int,
    n_columns: int,
    scattering_bytes: int = 0,
) -> int:
    """Predict the peak memory of a block of ``n_columns`` coefficients.

    Parameters
    ----------
    n_verts, part_terms, n_rays
        Of each part; no rays where nothing bounces.
    hit_share
        Of the rays that meet a surface.  All vertices are taken to have such a ray.
    n_channels
        Of the transfer.
    scattering_bytes
        Of rows (see `scattering_memory_bytes`).
    """
    values = sum(n * k for n, k in zip(n_verts, part_terms, strict=True))
    transfer = 4 * values * n_columns * (1 + TRANSFERS * n_channels)
    # every hit reads three corners of a part whose terms are taken to be the mean ones
    mean_terms = values / max(1, sum(n_verts))
    rays = sum(
        n * count * (4 * k + hit_share * n_channels * 8 * 3 * mean_terms)
        for n, k, count in zip(n_verts, part_terms, n_rays, strict=True)
    )
    # radiance along the rays that are carried at a time, as a sum and what is added to it
    carried = max(
        (min(n, VERTICES_PER_PRODUCT) * count for n, count in zip(n_verts, n_rays, strict=True)),
        default=0,
    )
    radiance = 8 * carried * n_columns
    return CHILD_BYTES + transfer + round(rays) + radiance + scattering_bytes
