"""Bytes that a number of factors takes in a file: clusters compressed, rounded and packed.

The bits follow from the error that compression leaves, of which rounding may add a share, and from
what columns carry: see `prtbake_workers.compress.bit_allocation`.  Both show in a few clusters; the
steps are those of the whole part, where the same error is shared by all of its numbers.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prtbake_storage.decode.asset import Part
from prtbake_storage.decode.quantise import Scales, finest_scale, levels, round_part, stored_levels
from prtbake_workers.arrays import F32, F64, Float32, Float64
from prtbake_workers.compress.bit_allocation import (
    AIM,
    LARGEST_STRIDE,
    LEAST_SHARE,
    LEVEL_OF_IDLE_COLUMNS,
    Steps,
    measured,
)
from prtbake_workers.compress.methods import Fit, compress
from prtbake_workers.compress.rounding_error import number_weights
from prtbake_workers.planning.file_bytes import NumberBytes
from prtbake_workers.planning.packed_bytes import packed_bytes
from prtbake_workers.planning.presets import PartCompression

ITERATIONS = 2
"""Of clustering: the rest changes little of what is left."""

ROUNDS = 6
"""Of the search for the steps at most."""


@dataclass(frozen=True)
class WholePart:
    """What of a part there is beside the vertices that are looked at.

    Attributes
    ----------
    n_verts
        Vertices.
    compression
        As the whole is compressed.
    factor_floats
        Numbers of its factors.
    phi
        View side of the BRDF's terms; None where it is constant.
    """

    n_verts: int
    compression: PartCompression
    factor_floats: int
    phi: Float32[F32, "rows columns terms channels"] | None


def factor_bytes(
    coefficients: Float32[F32, "verts rows coeffs"],
    areas: Float64[F64, " verts"],
    drawn: int,
    whole: WholePart,
    *,
    share: float,
    max_error: float | None = None,
    n_channels: int = 1,
    seed: int = 0,
) -> NumberBytes | None:
    """Compress, round and pack some vertices; None where they have no area, and say nothing.

    Parameters
    ----------
    coefficients
        Whitened, of vertices of ``drawn`` clusters.
    areas
        Of these vertices.
    whole
        The part that they are of.
    share, max_error
        Of the squared error that compression leaves, that rounding adds; or, where it is given, of
        the transfer.
    """
    if not coefficients.any():
        return _dark_bytes(whole)
    if not areas.sum() > 0.0:
        return None
    own = areas / areas.sum()
    done = compress(
        whole.compression.method,
        coefficients,
        replace(whole.compression, n_clusters=drawn),
        Fit(
            seed=seed,
            max_iterations=ITERATIONS,
            n_channels=n_channels,
            vertex_weights=own,
            classification=whole.compression.classification,
        ),
    )
    part = _part(dict(done.factors), whole.phi, n_channels)
    # all clusters over those that were found; all vertices of these over those that are looked at
    more = max(1.0, whole.compression.n_clusters / part.n_clusters)
    fuller = whole.n_verts / (more * len(areas))
    added = share * done.model.squared_error_ratio if max_error is None else max_error
    bound = added * done.model.initial_energy
    scales = _scales(part, own, bound, whole, more=more, fuller=fuller)
    packed, numbers, texture = 0.0, 0.0, 0.0
    for name, rounded in round_part(part, scales).items():
        size = packed_bytes(stored_levels(rounded)[0])
        if name == "view_texture":
            texture = size / rounded.size
            continue
        times = more * (fuller if name == "weights" else 1.0)
        packed += times * size + more * packed_bytes(scales[name])
        numbers += times * rounded.size
    return NumberBytes(packed / numbers, texture) if numbers else None


def _dark_bytes(whole: WholePart) -> NumberBytes:
    """Pack zeros, and a texture whose columns carry nothing, which have 8 bits all the same."""
    zeros = np.zeros(max(1, whole.factor_floats), np.int8)
    texture = 0.0
    if whole.phi is not None:
        scale = finest_scale(np.abs(whole.phi).max(axis=(0, 1)), LEVEL_OF_IDLE_COLUMNS)
        texture = packed_bytes(levels(whole.phi, scale).astype(np.int8)) / whole.phi.size
    return NumberBytes(packed_bytes(zeros) / len(zeros), texture)


def _part(factors: dict[str, Any], phi: F32 | None, n_channels: int) -> Part:
    texture = None
    if phi is not None:
        texture = np.einsum("abkc,kr->abrc", phi, factors["view_basis"]).astype(np.float32)
    return Part(
        name="trial",
        role="object",
        two_sided=False,
        vertex_range=(0, len(factors["labels"])),
        material={},
        method="cta" if "light_bases" in factors else "cpca",
        albedo=np.ones(1, np.float32),
        albedo_texture=None,
        vertex_colours=None,
        view_texture=texture,
        factorisation=None,
        n_channels=n_channels,
        **factors,
    )


def _scales(
    part: Part, areas: F64, bound: float, whole: WholePart, *, more: float, fuller: float
) -> Scales:
    """Find the steps that the whole part will have, as `allocate_bits` does; areas sum to 1.

    The whole has ``more`` times the energy, and a cluster's is shared by ``fuller`` times the
    vertices.
    """
    weights = number_weights(part, areas)
    weights["weights"] = weights["weights"] / fuller
    count = float(whole.factor_floats)
    if part.view_texture is not None:
        # the same texels serve all clusters
        weights["view_texture"] = weights["view_texture"] * more
        count += part.view_texture.size
    steps = Steps(part, weights)
    step = float(np.sqrt(12.0 * more * bound / count))
    scales = steps.scales(step)
    for _ in range(ROUNDS):
        error = measured(part, scales, areas).total
        if LEAST_SHARE * bound <= error <= bound or steps.finest_reached(scales):
            break
        factor = float(np.sqrt(AIM * bound / error)) if error > 0.0 else LARGEST_STRIDE
        step *= min(max(factor, 1.0 / LARGEST_STRIDE), LARGEST_STRIDE)
        scales = steps.scales(step)
    return scales
