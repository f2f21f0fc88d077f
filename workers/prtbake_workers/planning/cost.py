"""A first cost model: rays, flops and bytes of every stage over rates of a plain 2-core machine.

The rates are order-of-magnitude figures measured once on two shared cores; the report of every
job gives what its stages really took, so a reader can see how far the model was off.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from prtbake_storage.contract.settings import (
    MEDIUM_PATHS,
    FitLightSettings,
    ValidateSettings,
)
from prtbake_workers.geometry.scene import Scene
from prtbake_workers.planning.presets import PartCompression, PlannedBake

RAYS_PER_SECOND = 5.0e6
FLOPS_PER_SECOND = 4.0e10
BOUNCE_RAYS_PER_SECOND = 5.0e5
"""Rays whose hits are turned into rows of a sparse matrix."""
SPARSE_FLOPS_PER_SECOND = 2.0e9
TRANSFER_SAMPLES_PER_SECOND = 1.5e8
"""Products psi * V * cos built for the projection, one term of one direction each."""
TERM_SAMPLES_PER_SECOND = 5.0e7
"""Of validation: one term at one point for one sample of the light, about half of which arrive."""
PATHS_PER_SECOND = 4.0e5
"""With all bounces, where two in three leave an open scene at once; a closed room takes four times
as long."""
SCATTERED_PATHS_PER_SECOND = 5.0e4
"""Paths that begin on a medium, with the lines that look for where light entered."""
CHILD_START_S = 1.5
LIGHT_TEXELS = 524_288
"""Of a map of 1024 x 512; each function is evaluated there twice."""
FUNCTION_VALUES_PER_SECOND = 5.0e7
"""Of lobes or harmonics, in each texel, in the projection and in what it leaves."""
ORIENTED_SECONDS, ORIENTED_BYTES = 8.0, 300_000_000
"""Of factorising one anisotropic BRDF; an isotropic one takes a fraction of a second."""
PROBE_SECONDS = 3.0
"""Of trying up to 642 centres on a few vertices; 2562 take some 5 s more."""
FITTED_DIRECTIONS, HELD_OUT_DIRECTIONS = 2048, 1536
"""Of a trial, at which samples stand in float64 at once."""
TILE_SECONDS = 8.0
"""A tile is the unit of resumption: long against its start, short against a human's patience."""
TILE_BYTES = 400_000_000
CHILD_BYTES = 130_000_000
"""The interpreter with what a bake imports."""
WORKSPACE_BYTES = 60_000_000
"""Of each thread of a tile."""


@dataclass(frozen=True)
class PartCost:
    """Predicted cost of one part."""

    bake_seconds: float
    compress_seconds: float
    transfer_bytes: int
    asset_bytes: int
    compress_memory_bytes: int


def bake_seconds_per_vertex(settings: PlannedBake, *, n_terms: int, shadows: bool) -> float:
    """Predict the seconds one thread spends on one vertex (half of the directions count)."""
    n_dirs = 3 * settings.cube_resolution**2
    rays = n_dirs * settings.supersample**2 if shadows else 0
    flops = 2.0 * n_dirs * n_terms * settings.n_coeffs * 1.2
    return (
        rays / RAYS_PER_SECOND
        + flops / FLOPS_PER_SECOND
        + n_dirs * n_terms / TRANSFER_SAMPLES_PER_SECOND
    )


def tile_vertices(
    settings: PlannedBake, *, n_terms: int, shadows: bool, chunk: int, n_channels: int = 1
) -> int:
    """Choose vertices a tile: about TILE_SECONDS of work, bounded memory, whole chunks."""
    if settings.tile_vertices is not None:
        wanted = float(settings.tile_vertices)
    else:
        seconds = bake_seconds_per_vertex(settings, n_terms=n_terms, shadows=shadows)
        vertex_bytes = 4 * n_channels * n_terms * settings.n_coeffs
        wanted = min(TILE_SECONDS / seconds, TILE_BYTES / vertex_bytes, 16384)
    return chunk * max(1, int(wanted // chunk))


def probe_memory_bytes(*, n_functions: int, n_directions: int, n_coeffs: int) -> int:
    """Predict the peak memory of trying directions and centres, without the interpreter.

    Parameters
    ----------
    n_functions
        Vertices x terms of all parts, or fewer sums of these.
    n_directions
        At which all of them are held.
    n_coeffs
        The most centres that were tried.
    """
    samples = 4 * n_functions * n_directions
    # what a fit misses and its square, or what it solves for: a block, their sum and the solution
    fitting = 8 * n_functions * max(2 * HELD_OUT_DIRECTIONS, FITTED_DIRECTIONS + 3 * n_coeffs)
    system = 8 * (FITTED_DIRECTIONS * n_coeffs + 3 * n_coeffs**2)
    return samples + max(fitting + system, WORKSPACE_BYTES)


def plan_memory_bytes(bake: PlannedBake, *, oriented: bool = False, probe_bytes: int = 0) -> int:
    """Predict the peak memory of planning: basis and projection, without scene and texture.

    ``oriented`` tells that a BRDF is anisotropic, which is factorised before; ``probe_bytes`` what
    choosing directions or centres held, see `probe_memory_bytes`.
    """
    n_dirs, n_coeffs = 6 * bake.cube_resolution**2, bake.n_coeffs
    solving = 8 * (3 * n_dirs * n_coeffs + 7 * n_coeffs**2)
    return CHILD_BYTES + max(solving, ORIENTED_BYTES if oriented else 0, probe_bytes)


def tile_memory_bytes(bake: PlannedBake, *, n_terms: int, n_verts: int) -> int:
    """Predict the peak memory of a tile, without the scene: what it reads, makes and packs."""
    n_dirs, n_coeffs = 6 * bake.cube_resolution**2, bake.n_coeffs
    # basis and projection in float64, in float32, and every thread's share of the latter
    projection = (8 + 8 + 4 + 4 * bake.threads) * n_dirs * n_coeffs + 32 * n_coeffs**2
    values = n_verts * n_terms * n_coeffs
    return CHILD_BYTES + projection + 6 * values + bake.threads * WORKSPACE_BYTES


def part_cost(
    bake: PlannedBake,
    compression: PartCompression,
    *,
    n_verts: int,
    n_terms: int,
    shadows: bool,
    iterations: int,
    n_channels: int = 1,
) -> PartCost:
    """Predict seconds, bytes and memory of baking and compressing one part.

    ``n_channels`` 3 stores and compresses three times the rows; the rays and the projection of
    direct light stay those of one.
    """
    n_coeffs = bake.n_coeffs
    values = n_verts * n_channels * n_terms * n_coeffs
    view, light, vert = compression.ranks
    clusters = compression.n_clusters
    if compression.method == "cta":
        rows = n_channels * view
        classify = 2.0 * n_verts * (rows * n_coeffs) * (clusters * vert)
        model = 8.0 * n_verts * rows * n_coeffs * (view * light + n_coeffs / 2)
        floats = (
            n_terms * view + clusters * (n_coeffs * light + vert * rows * light) + n_verts * vert
        )
        memory = 4 * values + 8 * n_verts * rows * n_coeffs
    else:
        # a vertex's matrix is one signal, of which a cluster keeps its mean and components
        rank, dims = compression.n_components, n_channels * n_terms * n_coeffs
        classify = 2.0 * values * clusters
        # once: the Gram matrix of the shorter side, a cluster's vertices or its dimensions
        side = min(n_verts // clusters, dims) if rank else 0
        model = 2.0 * values * side / iterations
        floats = clusters * dims * (rank + 1) + n_verts * rank
        # of the clusters being fitted: rows in float64, what is left of them, and Gram matrices
        fitted = min(2, clusters) if rank else 0
        copied = max(8 * values, fitted * 20 * values // clusters)
        if compression.method == "pca":
            copied = 0  # one cluster of everything is summed piece by piece
        memory = 4 * values + copied + fitted * 24 * side**2
    return PartCost(
        bake_seconds=n_verts * bake_seconds_per_vertex(bake, n_terms=n_terms, shadows=shadows),
        compress_seconds=iterations * (classify + model) / (2 * FLOPS_PER_SECOND),
        transfer_bytes=2 * values,
        asset_bytes=2 * floats,
        compress_memory_bytes=memory,
    )


def bounce_seconds(
    scene: Scene,
    part_terms: Sequence[int],
    *,
    bounces: int,
    n_rays: Sequence[int],
    later_rays: Sequence[int],
    hit_share: float,
    n_channels: int,
    n_coeffs: int,
    n_blocks: int,
) -> float:
    """Predict the seconds of all bounces: rays once a block, sparse and dense products a bounce."""
    verts = np.array([stop - start for start, stop in scene.part_ranges])
    terms = np.array(part_terms)
    # every hit reads three corners of a part whose terms are taken to be the mean ones
    mean_terms = float(verts @ terms) / float(verts.sum())

    def once(rays_of: Sequence[int]) -> tuple[float, float]:
        """Of casting the rays, and of one bounce by them."""
        rays = float(verts @ np.array(rays_of))
        sparse = 2.0 * hit_share * rays * 3.0 * mean_terms * n_coeffs / SPARSE_FLOPS_PER_SECOND
        dense = 2.0 * float((verts * terms) @ np.array(rays_of)) * n_coeffs / FLOPS_PER_SECOND
        return rays / BOUNCE_RAYS_PER_SECOND, sparse + dense

    (cast, first), (recast, later) = once(n_rays), once(later_rays)
    if tuple(later_rays) == tuple(n_rays):
        recast = 0.0
    traced = n_blocks * (CHILD_START_S + cast + recast)
    return traced + n_channels * (first + max(bounces - 1, 0) * later)


def compress_seconds(costs: Sequence[PartCost]) -> float:
    """Predict the seconds of compressing all parts and writing the asset."""
    return CHILD_START_S * 2 + sum(cost.compress_seconds for cost in costs)


def compress_memory_bytes(costs: Sequence[PartCost]) -> int:
    """Predict the peak memory of compressing the largest part, the interpreter included."""
    return max(cost.compress_memory_bytes for cost in costs) + 250_000_000


def fit_seconds(settings: FitLightSettings) -> float:
    """Predict the seconds of a fit: texels x lobes x iterations, or texels x functions.

    A target for the error is taken to ask for as many lobes as it may.
    """
    if settings.method == "srbf_scattered":
        return 2.0 + 0.05 * (settings.n_lobes or 0) * (settings.max_iterations or 0)
    n_functions = (settings.n_centres or 0) + (settings.sh_order or 0) ** 2
    return CHILD_START_S + LIGHT_TEXELS * (1 + n_functions) / FUNCTION_VALUES_PER_SECOND


def validate_seconds(
    settings: ValidateSettings,
    *,
    n_terms: int,
    n_dirs: int,
    baked_bounces: bool = False,
    media: bool = False,
) -> float:
    """Predict the seconds of all chains of pictures, with paths where the reference has bounces.

    And where ``media`` scatter light inside: half of what is seen is taken to show one.
    """
    pixels = 0.5 * settings.width * settings.height
    samples = settings.passes * settings.samples
    one = pixels * samples * (4.0 / RAYS_PER_SECOND + 3.0 * n_terms / TERM_SAMPLES_PER_SECOND)
    if settings.reference_bounces(baked=baked_bounces):
        one += pixels * settings.passes * settings.paths / PATHS_PER_SECOND
    if media:
        paths = MEDIUM_PATHS * settings.paths
        one += 0.5 * pixels * settings.passes * paths / SCATTERED_PATHS_PER_SECOND
    cells = pixels * n_dirs * (1.0 / RAYS_PER_SECOND + n_terms / TRANSFER_SAMPLES_PER_SECOND)
    return len(settings.cameras) * (len(settings.rotations_deg) * one + cells)
