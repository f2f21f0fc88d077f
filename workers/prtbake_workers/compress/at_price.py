"""A part at a price of its bytes: columns that are not worth theirs left out, the rest rounded.

The least error for a number of bytes has one price: nothing that is kept wins less squared error a
byte than it, and nothing that is left out would win more.  Where numbers are coded by their entropy
one distortion D = s^2 / 12 of every number, in units of the squared error, is such a price
(`prtbake_workers.compress.bit_allocation`): halving D costs half a bit a number, so a bit is worth
2 ln 2 D.  The same D for all numbers of all parts shares the bytes out among clusters, columns and
parts alike, so that the squared error of all parts together is the least.

A column of energy E is m numbers in one factor and l in another (weights and a row of the dual
basis or a component, or a row of the light basis and entries of the dual one).  Neither is any use
alone, so it stays only as a whole: where E less what rounding leaves of it pays for its bits.
"""

from dataclasses import replace

import numpy as np

from prtbake_storage.decode.asset import Part
from prtbake_storage.decode.quantise import Scales
from prtbake_workers.arrays import B8, F32, F64, Bool, Float32, Float64
from prtbake_workers.compress.bit_allocation import Steps
from prtbake_workers.compress.rounding_error import number_weights
from prtbake_workers.compress.trim import compacted

NUMBER_PRICE = 2.0 * np.log(2.0)
"""Squared error that a bit of one number is worth, in units of the distortion D."""


def at_distortion(
    part: Part, areas: Float64[F64, " verts"], distortion: float
) -> tuple[Part, Scales]:
    """Leave out columns of an exact part, and choose the scales of what stays.

    Parameters
    ----------
    part
        Exact factors, with orthonormal bases.
    areas
        Weights of the part's vertices, 0 or more.
    distortion
        D, squared error that rounding may add by each number, above 0; weighted by the same areas.

    Returns
    -------
    Part, Scales
        The part still exact, its arrays as wide as the largest rank that is left, one at least.
    """
    left = _paid(part, number_weights(part, areas), distortion)
    weights = number_weights(left, areas)
    scales = Steps(left, weights).scales(float(np.sqrt(12.0 * distortion)))
    if "view_texture" in scales:
        # columns that no light comes by
        idle = np.broadcast_to(weights["view_texture"], scales["view_texture"].shape) <= 0.0
        scales["view_texture"] = np.where(idle, np.float32(0.0), scales["view_texture"])
    return left, scales


def _paid(part: Part, weights: dict[str, F64], distortion: float) -> Part:
    """Leave out columns that do not pay: of the light basis first, as they shorten the others."""
    members = np.bincount(part.labels, minlength=part.n_clusters).astype(np.float64)
    if part.light_bases is None or part.dual_bases is None:
        if part.components is None or not part.components.size:
            return part
        lengths = np.full(len(members), float(part.components.shape[2]))
        idle = _idle(weights["components"][..., 0], members, lengths, distortion)
        given, rows, vert = compacted(
            part.weights, part.components, part.labels, part.ranks[:, 2], idle
        )
        columns = np.column_stack([part.ranks[:, :2], vert])
        return replace(part, weights=given, components=rows, ranks=columns)
    view, _, vert = part.ranks.T
    numbers = (part.n_channels * view * vert).astype(np.float64)
    coeffs = np.full(len(members), float(part.light_bases.shape[1]))
    idle = _idle(weights["light_bases"][:, 0], numbers, coeffs, distortion)
    part, dual = _without_light(part, part.light_bases, part.dual_bases, idle)
    lengths = (part.n_channels * view * part.ranks[:, 1]).astype(np.float64)
    idle = _idle(weights["dual_bases"][..., 0], members, lengths, distortion)
    given, rows, vert = compacted(part.weights, dual, part.labels, part.ranks[:, 2], idle)
    columns = np.column_stack([part.ranks[:, :2], vert])
    return replace(part, weights=given, dual_bases=rows, ranks=columns)


def _idle(
    energies: Float64[F64, "clusters columns"],
    first: Float64[F64, " clusters"],
    second: Float64[F64, " clusters"],
    distortion: float,
) -> Bool[B8, "clusters columns"]:
    """Find columns whose energy does not pay for the bits of their numbers, first and second."""
    bits, kept = np.zeros_like(energies), np.zeros_like(energies)
    for numbers in (first, second):
        spread = np.maximum(numbers, 1.0)[:, None]
        bits += 0.5 * spread * np.log2(np.maximum(energies / (spread * distortion), 1.0))
        kept += np.minimum(energies, spread * distortion)
    found: B8 = energies - kept <= NUMBER_PRICE * distortion * bits
    return found


def _without_light(
    part: Part,
    light_bases: Float32[F32, "clusters coeffs light"],
    dual_bases: Float32[F32, "clusters vert channel_view_light"],
    idle: Bool[B8, "clusters columns"],
) -> tuple[Part, Float32[F32, "clusters vert kept"]]:
    """Leave out columns of the light bases; also the dual ones, without what these held of them."""
    width = light_bases.shape[2]
    stays = ~idle & (np.arange(width) < part.ranks[:, 1:2])
    ranks = stays.sum(axis=1).astype(np.int32)
    kept = max(1, int(ranks.max(initial=0)))
    order = np.argsort(~stays, axis=1, kind="stable")[:, :kept]
    filled = np.arange(kept) < ranks[:, None]
    light = np.take_along_axis(light_bases, order[:, None], axis=2) * filled[:, None]
    clusters, rows, _ = dual_bases.shape
    dual = dual_bases.reshape(clusters, rows, -1, width)
    dual = np.take_along_axis(dual, order[:, None, None], axis=3) * filled[:, None, None]
    columns = np.column_stack([part.ranks[:, 0], ranks, part.ranks[:, 2]])
    return replace(part, light_bases=light, ranks=columns), dual.reshape(clusters, rows, -1)
