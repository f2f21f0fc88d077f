"""What factors of a scene's parts will take a number: a trial of a few clusters of each part.

No size tells it: where compression leaves next to nothing, of smooth or exactly low-rank transport,
numbers have many bits, and few where it leaves much.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

from prtbake_workers.basis.incident import IncidentBasis
from prtbake_workers.brdf.factorisation import Factorisation
from prtbake_workers.brdf.view_texture import view_texture
from prtbake_workers.geometry.accelerator import Accelerator
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.file_bytes import NumberBytes, texture_side
from prtbake_workers.planning.packed_factors import WholePart, factor_bytes
from prtbake_workers.planning.planned import Plan
from prtbake_workers.planning.sampled_clusters import (
    SampledDirections,
    draw_clusters,
    sampled_coefficients,
)
from prtbake_workers.planning.stage_work import total
from prtbake_workers.planning.trial_work import TrialSize, directions_bytes, directions_work

MOST_FUNCTIONS = 1000
"""Of a basis that is tried: more take seconds to make orthonormal."""

SCATTERED_MORE, COLOURED_LESS = 1.2, 0.85
"""Bytes a number of parts whose light is scattered inside, which is smoother than what falls on
them, and of those with bounces in three colours, which are much the same, over those of a trial,
which has neither.  Measured on seven and on four parts."""

MOST_BYTES = 2.0
"""Of a number: 16 bits."""


@dataclass(frozen=True)
class Trials:
    """What trials of all parts found and did.

    Attributes
    ----------
    number_bytes
        Of each part; None where nothing was tried.  Of a part that no light reaches directly they
        are those of zeros: bounces are taken not to reach it either.
    memory_bytes
        Predicted peak, without the interpreter and the scene.
    work
        The amounts of `plan_work` for trials.
    """

    number_bytes: tuple[NumberBytes | None, ...]
    memory_bytes: int
    work: dict[str, float]


def try_parts(
    scene: Scene,
    occluders: Sequence[Accelerator | None],
    factorisations: Sequence[Factorisation],
    plan: Plan,
    basis: IncidentBasis,
    *,
    cube_resolution: int,
    share: float,
    max_error: float | None = None,
    seed: int,
) -> Trials:
    """Compress a few clusters of each part.

    Parameters
    ----------
    scene, occluders, factorisations, plan
        As the bake will have them.
    basis
        Of incident light.
    cube_resolution
        Of the bake.
    share, max_error
        Of the squared error that compression leaves, that rounding adds; or of the transfer.
    seed
        Chooses vertices.

    Notes
    -----
    BLAS runs on one thread, so that the same job finds the same bytes everywhere.
    """
    rng = np.random.default_rng(seed)
    found: list[NumberBytes | None] = []
    sizes: list[TrialSize] = []
    alike = _alike(plan)
    with threadpool_limits(limits=1, user_api="blas"):
        directions = SampledDirections.of(basis, cube_resolution)
        n_dirs = directions.at.n
        for index, (part, brdf) in enumerate(zip(plan.parts, factorisations, strict=True)):
            n_values = brdf.n_terms * basis.n
            verts, drawn = draw_clusters(
                scene,
                index,
                part.compression.n_clusters,
                rank=part.compression.rank,
                n_values=n_values,
                rng=rng,
            )
            if drawn == 0:
                found.append(None)
                continue
            coefficients = sampled_coefficients(scene, verts, brdf, occluders[index], directions)
            n_channels = 3 if index in alike else 1
            side = None if brdf.is_constant_phi else texture_side(brdf)
            start, stop = part.vertex_range
            whole = WholePart(
                n_verts=stop - start,
                compression=part.compression,
                factor_floats=part.cost.factor_floats,
                phi=None if side is None else view_texture(brdf, side, supersample=1),
            )
            tried = factor_bytes(
                np.tile(coefficients, (1, n_channels, 1)),
                scene.areas[verts],
                drawn,
                whole,
                share=share,
                max_error=max_error,
                n_channels=n_channels,
                seed=seed,
            )
            found.append(None if tried is None else _scaled(tried, _beyond_direct(plan, index)))
            sizes.append(
                TrialSize(
                    n_verts=len(verts),
                    n_terms=brdf.n_terms,
                    n_coeffs=basis.n,
                    n_channels=n_channels,
                    n_dirs=n_dirs,
                    whole_verts=whole.n_verts,
                    compression=replace(part.compression, n_clusters=drawn),
                    rays=occluders[index] is not None,
                    texels=0 if whole.phi is None else whole.phi.size,
                )
            )
    own = directions_bytes(n_dirs=n_dirs, n_coeffs=basis.n)
    held = max((size.memory_bytes for size in sizes), default=0)
    return Trials(
        tuple(found),
        max(own, held + own // 8),
        total([directions_work(n_dirs=n_dirs, n_coeffs=basis.n), *(size.work for size in sizes)]),
    )


def _beyond_direct(plan: Plan, part: int) -> float:
    """Give what light that no trial follows does to the bytes of a number."""
    if plan.bounces is None:
        return 1.0
    if part in plan.bounces.scattering:
        return SCATTERED_MORE
    return COLOURED_LESS if plan.bounces.coloured else 1.0


def _scaled(tried: NumberBytes, factor: float) -> NumberBytes:
    return NumberBytes(min(MOST_BYTES, factor * tried.factors), tried.texture)


def _alike(plan: Plan) -> set[int]:
    """Name the parts with three channels that hold much the same: only media tell them apart."""
    bounces = plan.bounces
    if bounces is None or bounces.n_channels == 1 or bounces.coloured:
        return set()
    return set(range(len(plan.parts))) - set(bounces.scattering)
