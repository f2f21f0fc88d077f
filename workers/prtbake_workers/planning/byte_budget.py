"""Sizes of a compression that is to fit a number of bytes: ample ones, of which the rest is cut.

What a budget of bytes is worth is found in the end, column by column and bit by bit
(`prtbake_workers.compress.at_price`).  Sizes have only to be large enough for that.  Errors at
equal bytes hardly depend on how much larger they are (a few per cent between 2 and 20 numbers a
byte on a glossy teapot on a plane), while the fit takes longer.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prtbake_storage.contract.settings import MOST_CLUSTERS
from prtbake_storage.hdf5.transfer import TransferHeader, TransferPart
from prtbake_workers.planning.cost import factor_floats
from prtbake_workers.planning.packed_bytes import packed_bytes
from prtbake_workers.planning.presets import PartCompression

NUMBERS_A_BYTE = 4.0
"""That compression is given, of what the mesh leaves of the budget."""

MEANS_A_BYTE = 1.2
"""The same for vector quantisation, which has no columns to leave out afterwards."""

SMALLEST_SCALE = 0.25
"""Of ranks and components below those of the ladder."""

MOST_STEPS = 40
"""Bisections of the scale: to a part in 1e9."""


def sized_to_bytes(
    header: TransferHeader,
    compressions: Sequence[PartCompression],
    max_bytes: int,
    *,
    clusters_given: bool,
) -> list[PartCompression]:
    """Scale the sizes of all parts alike, until their numbers are ample for the bytes.

    Parameters
    ----------
    compressions
        Of each part, as the ladder has them.
    max_bytes
        Of the whole file; what mesh and frames pack to is left aside.
    clusters_given
        Leaves the numbers of clusters as they are.  Otherwise larger budgets take more of them:
        above the ladder's sizes the scale's root goes to clusters and to ranks each.
    """
    left = max(0.0, float(max_bytes - _mesh_bytes(header)))
    coeffs = header.basis.n_coeffs

    def at(scale: float) -> list[PartCompression]:
        return [
            _scaled(part, own, coeffs, scale, clusters_given)
            for part, own in zip(header.parts, compressions, strict=True)
        ]

    def numbers(scaled: Sequence[PartCompression]) -> float:
        """Count numbers over how many a byte is given."""
        return sum(
            factor_floats(
                own,
                n_verts=part.n_vertices,
                n_terms=part.n_terms,
                n_coeffs=coeffs,
                n_channels=part.n_channels,
            )
            / (MEANS_A_BYTE if own.method == "vq" else NUMBERS_A_BYTE)
            for part, own in zip(header.parts, scaled, strict=True)
        )

    low, high = 1e-4, 1e6
    if numbers(at(high)) <= left:
        return at(high)
    for _ in range(MOST_STEPS):
        middle = sqrt(low * high)
        low, high = (middle, high) if numbers(at(middle)) <= left else (low, middle)
    return at(high)


def _mesh_bytes(header: TransferHeader) -> int:
    """Pack the mesh as assets hold it."""
    units = np.round(header.normals * 32767.0).astype(np.int16)
    arrays: list[NDArray[Any]] = [header.positions.astype(np.float32), header.faces, units]
    # a tangent packs to about what a normal does
    arrays += [units[slice(*own.vertex_range)] for own in header.parts if own.frames is not None]
    if header.uv is not None:
        arrays.append(header.uv.astype(np.float32))
    return sum(packed_bytes(array) for array in arrays)


def _scaled(
    part: TransferPart, own: PartCompression, n_coeffs: int, scale: float, clusters_given: bool
) -> PartCompression:
    """Scale one part, as far as its factors are fewer numbers than its transfer."""
    n_verts, n_rows = part.n_vertices, part.n_channels * part.n_terms
    dims = n_rows * n_coeffs
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
