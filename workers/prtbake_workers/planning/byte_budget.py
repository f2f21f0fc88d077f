"""Sizes of a compression that is to fit a number of bytes: ample ones, of which the rest is cut.

What a budget of bytes is worth is found in the end, column by column and bit by bit
(`prtbake_workers.compress.at_price`).  Sizes have only to be large enough for that.  Errors at
equal bytes hardly depend on how much larger they are (a few per cent between 2 and 20 numbers a
byte on a glossy teapot on a plane), while the fit takes longer.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import sqrt

from prtbake_storage.contract.settings import MOST_CLUSTERS
from prtbake_workers.planning.cost import factor_floats
from prtbake_workers.planning.presets import PartCompression

NUMBERS_A_BYTE = 4.0
"""That compression is given, of what the mesh leaves of the budget."""

MEANS_A_BYTE = 1.2
"""The same for vector quantisation, which has no columns to leave out afterwards."""

SMALLEST_SCALE = 0.25
"""Of ranks and components below those of the ladder."""

MOST_STEPS = 40
"""Bisections of the scale: to a part in 1e9."""


@dataclass(frozen=True)
class Extent:
    """Shape of a part's transfer: vertices, channels x terms, and coefficients."""

    n_verts: int
    n_terms: int
    n_coeffs: int
    n_channels: int


def sized_to_bytes(
    extents: Sequence[Extent],
    compressions: Sequence[PartCompression],
    factor_bytes: float,
    *,
    clusters_given: bool,
) -> list[PartCompression]:
    """Scale the sizes of all parts alike, until their numbers are ample for the bytes.

    Parameters
    ----------
    extents, compressions
        Of each part; sizes as the ladder has them.
    factor_bytes
        What the mesh leaves of the file; 0 or less for the smallest sizes.
    clusters_given
        Leaves the numbers of clusters as they are.  Otherwise larger budgets take more of them:
        above the ladder's sizes the scale's root goes to clusters and to ranks each.
    """

    def at(scale: float) -> list[PartCompression]:
        return [
            _scaled(part, own, scale, clusters_given)
            for part, own in zip(extents, compressions, strict=True)
        ]

    def numbers(scaled: Sequence[PartCompression]) -> float:
        """Count numbers over how many a byte is given."""
        return sum(
            factor_floats(own, **asdict(part))
            / (MEANS_A_BYTE if own.method == "vq" else NUMBERS_A_BYTE)
            for part, own in zip(extents, scaled, strict=True)
        )

    low, high = 1e-4, 1e6
    if numbers(at(high)) <= factor_bytes:
        return at(high)
    for _ in range(MOST_STEPS):
        middle = sqrt(low * high)
        low, high = (middle, high) if numbers(at(middle)) <= factor_bytes else (low, middle)
    return at(high)


def _scaled(
    part: Extent, own: PartCompression, scale: float, clusters_given: bool
) -> PartCompression:
    """Scale one part, as far as its factors are fewer numbers than its transfer."""
    n_verts, n_coeffs = part.n_verts, part.n_coeffs
    dims = part.n_channels * part.n_terms * n_coeffs
    if own.method == "vq":
        if clusters_given:
            return own
        return replace(own, n_clusters=_of(own.n_clusters, scale, min(n_verts, MOST_CLUSTERS)))
    root = max(SMALLEST_SCALE, scale)
    clusters = own.n_clusters
    if root > 1.0 and own.method != "pca" and not clusters_given:
        root = sqrt(root)
        clusters = _of(clusters, root, min(MOST_CLUSTERS, max(1, n_verts // 8)))
    if own.method == "cta":
        view, light, vert = own.ranks
        view = _of(view, max(1.0, root), part.n_terms)
        rows = part.n_channels * view
        vert = _of(vert, root, max(1, min(n_verts // clusters, rows * n_coeffs)))
        light = _of(light, root, min(n_coeffs, rows * vert))
        return replace(own, n_clusters=clusters, ranks=(view, light, vert))
    most = (n_verts - clusters) * dims // (clusters * dims + n_verts)
    components = _of(own.n_components, root, max(1, min(n_verts, dims, most)))
    return replace(own, n_clusters=clusters, n_components=components)


def _of(size: int, scale: float, most: int) -> int:
    return max(1, min(most, round(size * scale)))
