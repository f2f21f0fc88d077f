"""What a block of bounced coefficients holds: its transfer, its rays, its rows of scattering."""

from collections.abc import Sequence

from prtbake_workers.planning.cost import CHILD_BYTES
from prtbake_workers.transport.separable_bounce import VERTICES_PER_PRODUCT

TRANSFERS = 3
"""Channels of transfer held at once: the sum, what was sent, what arrives; what leaves takes the
place of the latter, a part at a time."""

TERMS_OVER_ORDER, TURNED_BYTES = 4, 20
"""Terms of a glossy part for one of those that are averaged at a time, the cosines of its largest
order, and what averaging holds of a coefficient of those: complex, and real beside it.  The first
is a guess, as plans do not tell orders here; with it jobs that averaged are within 8 %."""


def bounce_memory_bytes(
    n_verts: Sequence[int],
    part_terms: Sequence[int],
    *,
    n_rays: Sequence[int],
    hit_share: float,
    n_channels: int,
    n_columns: int,
    smoothed: Sequence[bool] = (),
    scattering_bytes: int = 0,
) -> int:
    """Predict the peak memory of a block of ``n_columns`` coefficients.

    Parameters
    ----------
    n_verts, part_terms, n_rays
        Of each part; no rays where nothing bounces.
    hit_share
        Of the rays that meet a surface, which are taken to be spread evenly over the vertices.
    n_channels
        Of the transfer.
    smoothed
        Parts whose bounces may be averaged over neighbours, as their terms turn with their frames.
    scattering_bytes
        Of rows (see `scattering_memory_bytes`).
    """
    values = sum(n * k for n, k in zip(n_verts, part_terms, strict=True))
    one = 4 * values * n_columns
    transfer = one * (1 + TRANSFERS * n_channels)
    # every hit reads three corners of a part whose terms are taken to be the mean ones
    mean_terms = values / max(1, sum(n_verts))
    rays = sum(
        n * count * (4 * k + hit_share * n_channels * 8 * 3 * mean_terms)
        for n, k, count in zip(n_verts, part_terms, n_rays, strict=True)
    )
    # radiance along the rays that are carried at a time, as a sum and what is added to it, of the
    # vertices that see a surface
    carried = max(
        (
            min(n, VERTICES_PER_PRODUCT) * count * (1.0 - (1.0 - hit_share) ** count)
            for n, count in zip(n_verts, n_rays, strict=True)
        ),
        default=0,
    )
    bouncing = transfer + round(rays + 8 * carried * n_columns)
    # one more channel of transfer, and an order's terms as complex numbers
    turned = max(
        (
            n * max(1, k // TERMS_OVER_ORDER) if own and k > 1 else 0
            for n, k, own in zip(
                n_verts, part_terms, smoothed or [False] * len(n_verts), strict=True
            )
        ),
        default=0,
    )
    smoothing = transfer + one * n_channels + TURNED_BYTES * turned * n_columns if turned else 0
    return CHILD_BYTES + max(bouncing, smoothing) + scattering_bytes
