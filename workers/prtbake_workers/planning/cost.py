"""What a job will hold and leave: bytes of artefacts, peak memory of stages, vertices of a tile.

What it will take is predicted by `stage_work` and `rates`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from prtbake_workers.compress.energy import CHUNK_BYTES as ROWS_BYTES
from prtbake_workers.planning.presets import PartCompression, PlannedBake
from prtbake_workers.transport.bake import CHUNK_BYTES

RAYS_PER_SECOND = 5.0e6
FLOPS_PER_SECOND = 4.0e10
TRANSFER_SAMPLES_PER_SECOND = 1.5e8
"""Round figures that tiles are cut by.  They are the same on every machine, whatever its rates: the
cuts are part of what a job makes."""

ORIENTED_BYTES, ORIENTED_TERM_BYTES = 90_000_000, 3_300_000
"""Of factorising one anisotropic BRDF, and of each of its terms."""
GLOSSY_BYTES, BOUNCE_PROBE_BYTES = 58_000_000, 45_000_000
"""Of factorising an isotropic BRDF with a lobe, and of following the first bounce."""
FITTED_DIRECTIONS, HELD_OUT_DIRECTIONS = 2048, 1536
"""Of a trial, at which samples stand in float64 at once."""
TILE_SECONDS = 8.0
"""A tile is the unit of resumption: long against its start, short against a human's patience."""
TILE_BYTES = 400_000_000
CHILD_BYTES = 130_000_000
"""The interpreter with what a bake imports."""
SMALL_WORKSPACE_BYTES = 10_000_000
"""Of each thread of a tile, beside its samples."""
SAMPLE_BYTES, SAMPLE_TERM_BYTES = 16, 9
"""Of a vertex in a direction: its local direction and visibility, and each term."""
GROUP_VERTS, GROUPS = 64, 16
"""Vertices with much the same normal: a share of the tile's, and no fewer than so many."""
THREADS = 2
"""Of compression, as settings have it unless they say otherwise."""
COMPRESS_CHILD_BYTES = 137_000_000
"""The interpreter with what compression imports, its threads and files open, as the smallest parts
take."""
HELD_BYTES = 1 << 30
"""Of a part's float32 coefficients, up to which a tensor approximation holds them in memory."""
READ_CHUNK_BYTES = 200_000_000
"""Of chunks that a thread reads where they are not held: 32 MiB of view rows, what these are
projected from, and copies."""
WORKSPACE_BYTES = 60_000_000
"""Of trials, where they hold little else."""


@dataclass(frozen=True)
class PartCost:
    """What one part is predicted to leave and to hold."""

    transfer_bytes: int
    """Of its coefficients in 16 bits, before they are packed."""
    factor_floats: int
    """Numbers that its factors hold."""
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


def plan_memory_bytes(bake: PlannedBake, *, probe_bytes: int = 0) -> int:
    """Predict the peak memory of planning: basis and projection, without scene and texture.

    ``probe_bytes`` is what was held before: by factorising and by probing (`before_basis_bytes`),
    or by choosing directions or centres (`probe_memory_bytes`).
    """
    n_dirs, n_coeffs = 6 * bake.cube_resolution**2, bake.n_coeffs
    # functions in all directions: cosines, these within bounds, their exponents, the values
    solving = 8 * (4 * n_dirs * n_coeffs + 7 * n_coeffs**2)
    return CHILD_BYTES + max(solving, probe_bytes)


def before_basis_bytes(part_terms: Sequence[int], *, n_oriented: int) -> int:
    """Predict what factorising the parts' BRDFs holds, and following the first bounce."""
    if n_oriented:
        return ORIENTED_BYTES + ORIENTED_TERM_BYTES * max(part_terms)
    return GLOSSY_BYTES if max(part_terms) > 1 else BOUNCE_PROBE_BYTES


def tile_memory_bytes(bake: PlannedBake, *, n_terms: int, n_verts: int, flat: bool = False) -> int:
    """Predict the peak memory of a tile, without the scene: what it reads, makes and packs.

    Samples are made for vertices with much the same normal at a time, which on a ``flat`` part are
    all of them.
    """
    n_dirs, n_coeffs = 6 * bake.cube_resolution**2, bake.n_coeffs
    # the basis in float64, its product in float32, and what every thread picks of that: more than
    # half of the directions, of which a mirrored product takes one of two
    product, picked = (4.0, 2.4) if bake.cube_resolution % 2 else (5.0, 1.6)
    projection = int((8.0 + product + picked * bake.threads) * n_dirs * n_coeffs)
    projection += 32 * n_coeffs**2
    values = n_verts * n_terms * n_coeffs
    group = n_verts if flat else min(n_verts, max(GROUP_VERTS, n_verts // GROUPS))
    samples = min(CHUNK_BYTES // (4 * n_terms), group * n_dirs // 2)
    workspace = SMALL_WORKSPACE_BYTES + samples * (SAMPLE_BYTES + SAMPLE_TERM_BYTES * n_terms)
    return CHILD_BYTES + projection + 6 * values + bake.threads * workspace


def factor_floats(
    compression: PartCompression,
    *,
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    n_channels: int = 1,
) -> int:
    """Count the numbers that a part's factors hold."""
    view, light, vert = compression.ranks
    clusters = compression.n_clusters
    if compression.method == "cta":
        rows = n_channels * view
        own = clusters * (n_coeffs * light + vert * rows * light)
        return n_terms * view + own + n_verts * vert
    rank = compression.n_components
    return clusters * n_channels * n_terms * n_coeffs * (rank + 1) + n_verts * rank


def part_cost(
    bake: PlannedBake,
    compression: PartCompression,
    *,
    n_verts: int,
    n_terms: int,
    n_channels: int = 1,
) -> PartCost:
    """Predict bytes and memory of baking and compressing one part.

    ``n_channels`` 3 stores and compresses three times the rows.
    """
    n_coeffs = bake.n_coeffs
    values = n_verts * n_channels * n_terms * n_coeffs
    clusters = min(compression.n_clusters, n_verts)
    if compression.method == "cta":
        memory = _tensor_bytes(
            compression, n_verts=n_verts, n_terms=n_terms, n_coeffs=n_coeffs, n_channels=n_channels
        )
    else:
        # a vertex's matrix is one signal, of which a cluster keeps its mean and components
        rank, dims = compression.n_components, n_channels * n_terms * n_coeffs
        side = min(n_verts // clusters, dims) if rank else 0
        # of the clusters being fitted: rows in float64, what is left of them, and Gram matrices
        fitted = min(THREADS, clusters) if rank else 0
        copied = max(8 * values, fitted * 20 * values // clusters)
        if compression.method == "pca":
            copied = 0  # one cluster of everything is summed piece by piece
        memory = 4 * values + copied + fitted * 24 * side**2
    return PartCost(
        transfer_bytes=2 * values,
        factor_floats=factor_floats(
            compression,
            n_verts=n_verts,
            n_terms=n_terms,
            n_coeffs=n_coeffs,
            n_channels=n_channels,
        ),
        compress_memory_bytes=memory,
    )


def _tensor_bytes(
    compression: PartCompression, *, n_verts: int, n_terms: int, n_coeffs: int, n_channels: int
) -> int:
    """Transfer and what the view basis sees of it, with what threads make of chunks and clusters.

    What clusters freed is counted beside the projection on the view basis that follows: resident
    memory, traced in four jobs, has not fallen by then, which is taken to be the allocator's doing.
    """
    view, light, _ = compression.ranks
    columns = n_channels * view * light
    clusters = min(compression.n_clusters, n_verts)
    threads = min(THREADS, clusters)
    # clusters differ in size: the largest has about twice the vertices of the mean one
    largest = min(n_verts, 2 * n_verts // clusters)
    members = min(largest, n_verts // threads)
    values, seen = (4 * n_channels * rows * n_coeffs for rows in (n_terms, view))
    # of a chunk: what the view basis sees, what that gives back, and the rest
    projected = min(n_verts * values, THREADS * ROWS_BYTES) * (2 + view / n_terms)
    # of a cluster: its rows with their fit and what that leaves, or with what finds its bases; or
    # all of its transfer, for the view basis
    decomposed = _decomposition_bytes(members, columns)
    fitted = max(3 * members * seen, members * seen + decomposed, members * values)
    held = n_verts * (values + seen) + round(projected) + threads * fitted
    if n_verts * values <= HELD_BYTES and compression.tasks == 1:
        return held
    row = 6 * n_channels * n_terms * n_coeffs + 2 * seen
    read = THREADS * max(READ_CHUNK_BYTES, largest * row)
    read += THREADS * _decomposition_bytes(largest, columns)
    return min(held, 4 * n_verts * n_channels * n_terms + read)


def _decomposition_bytes(n_rows: int, n_columns: int) -> int:
    """Rows in float64 and their copy, and the shorter side's Gram matrix with what solves it."""
    return 16 * n_rows * n_columns + 48 * min(n_rows, n_columns) ** 2


def compress_memory_bytes(costs: Sequence[PartCost]) -> int:
    """Predict the peak memory of compressing the largest part, the interpreter included."""
    return COMPRESS_CHILD_BYTES + max(cost.compress_memory_bytes for cost in costs)
