"""How much work a stage has to do, in units that no machine changes: the counts of the cost model.

Each function gives the amounts of a stage, or of a part of one; those of parts add up (`total`).
``tasks`` are the processes to start.  `rates` says what a unit takes.
"""

from collections.abc import Iterable, Sequence

from prtbake_storage.contract.light import FitLightSettings
from prtbake_storage.contract.settings import MEDIUM_PATHS, RenderSettings, ValidateSettings
from prtbake_workers.planning.light_pieces import FitSamples, projected_pieces
from prtbake_workers.planning.presets import PartCompression, PlannedBake
from prtbake_workers.planning.rates import Amounts
from prtbake_workers.planning.seen_pixels import SeenPixels

PADDED_SHARE = 1.2
"""Directions that a group of vertices multiplies with, over those above one vertex's horizon."""

LBG_ITERATIONS = 5
SWEEPS = 2
APPROXIMATIONS = 3
"""Of the tensor approximation: clustering by distance, sweeps of a model step, and last steps."""

TRIED_SHARE = 0.14
"""Pairs of vertex and cluster that classification tries, see `classify.BLOCK_VERTS`."""

SAMPLES_A_SIDE = 2
"""Points a pixel of previews, along each side."""


def total(amounts: Iterable[Amounts]) -> dict[str, float]:
    """Add amounts up, unit by unit."""
    found: dict[str, float] = {}
    for one in amounts:
        for unit, amount in one.items():
            found[unit] = found.get(unit, 0.0) + amount
    return found


def plan_work(
    bake: PlannedBake,
    *,
    n_verts: int,
    n_glossy: int,
    n_oriented: int,
    trial_rays: float = 0.0,
    trial_flops: float = 0.0,
) -> dict[str, float]:
    """Count what planning does: tables of BRDFs, the basis and its projection, trials.

    ``n_glossy`` and ``n_oriented`` are the parts with an isotropic BRDF that has a lobe, and with
    an anisotropic one.
    """
    n_dirs, n_coeffs = 6 * bake.cube_resolution**2, bake.n_coeffs
    return {
        "tasks": 1.0,
        "vertices": float(n_verts),
        "glossy": float(n_glossy),
        "oriented": float(n_oriented),
        # the Gram matrix and the solution by it, and the eigenvalues of the basis
        "solve_flops": 4.0 * n_dirs * n_coeffs**2 + 10.0 * n_coeffs**3,
        "trial_flops": trial_flops,
        "trial_rays": trial_rays,
    }


def shadow_rays(bake: PlannedBake, *, n_verts: int) -> int:
    """Count the rays of vertices whose normals are usable: half of the directions are above each.

    Exact for one ray a direction, unless a direction lies in the plane of a surface; with more,
    those at the horizon are counted by halves.
    """
    return n_verts * 3 * bake.cube_resolution**2 * bake.supersample**2


def bake_work(
    bake: PlannedBake, *, n_verts: int, n_terms: int, shadows: bool, n_tiles: int
) -> dict[str, float]:
    """Count what baking a part does: rays, samples of psi V cos, their projection, storing it.

    Of SRBFs so wide that they nearly depend on each other half of the multiplications are counted:
    whether they have a `MirroredProduct` shows when it is made.
    """
    n_dirs = 3 * bake.cube_resolution**2
    # directions in the mirror's plane have no pairs: see `MirroredProduct`
    unpaired = 2.0 if bake.cube_resolution % 2 else 1.0
    flops = unpaired * PADDED_SHARE * 2.0 * n_verts * n_dirs * n_terms * bake.n_coeffs
    return {
        "tasks": float(n_tiles),
        "tables": float(n_tiles * 2 * n_dirs * bake.n_coeffs),
        "rays": (shadow_rays(bake, n_verts=n_verts) if shadows else 0) / bake.threads,
        "flops": flops / bake.threads,
        "samples": float(n_verts * n_dirs * n_terms) / bake.threads,
        "values": float(n_verts * n_terms * bake.n_coeffs),
    }


def bounce_work(
    n_verts: Sequence[int],
    part_terms: Sequence[int],
    *,
    bounces: int,
    n_rays: Sequence[int],
    later_rays: Sequence[int],
    hit_share: float,
    n_channels: int,
    n_coeffs: int,
    n_blocks: int,
) -> dict[str, float]:
    """Count what all bounces do: rays once a block, sparse and dense products a bounce.

    ``bounces`` 0 traces no ray.
    """
    values = sum(n * k for n, k in zip(n_verts, part_terms, strict=True))
    # every hit reads three corners of a part whose terms are taken to be the mean ones
    mean_terms = values / max(1, sum(n_verts))

    def once(rays_of: Sequence[int]) -> tuple[float, float, float]:
        """Rays, and the sparse and dense multiplications of one bounce by them."""
        rays = float(sum(n * r for n, r in zip(n_verts, rays_of, strict=True)))
        dense = sum(n * k * r for n, k, r in zip(n_verts, part_terms, rays_of, strict=True))
        sparse = 2.0 * hit_share * rays * 3.0 * mean_terms * n_coeffs
        return rays, sparse, 2.0 * float(dense) * n_coeffs

    (cast, *first), (recast, *later) = once(n_rays), once(later_rays)
    if tuple(later_rays) == tuple(n_rays) or bounces < 2:
        recast = 0.0
    taken = min(bounces, 1)
    sparse, dense = (
        n_channels * (taken * one + max(bounces - 1, 0) * more)
        for one, more in zip(first, later, strict=True)
    )
    return {
        "tasks": float(n_blocks),
        "rays": n_blocks * taken * (cast + recast),
        "sparse_flops": sparse,
        "dense_flops": dense,
        "values": float(values * n_channels * n_coeffs),
    }


def compress_work(
    compression: PartCompression,
    *,
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    iterations: int,
    threads: int = 1,
    n_channels: int = 1,
) -> dict[str, float]:
    """Count what compressing a part does: reading, products with all data, small decompositions.

    Threads share the clusters.  Where tasks share the steps, each step starts them anew and reads
    all data once more, projected on the view, and each classifying task folds all bases.
    """
    clusters = min(compression.n_clusters, n_verts)
    values = float(n_verts * n_channels * n_terms * n_coeffs)
    tasks, reads = 1, 1
    members = n_verts / clusters
    if compression.method == "cta":
        view, light, vert = compression.ranks
        rows = n_channels * view
        data = float(n_verts * rows * n_coeffs)
        vert = min(vert, n_verts, rows * light)
        steps = SWEEPS * iterations + APPROXIMATIONS
        rounds = (2 * iterations - 1) + 2 * APPROXIMATIONS
        again = 0.0
        if compression.tasks > 1:
            tasks, reads = 2 + compression.tasks * rounds, 2 + rounds
            folds = (iterations - 1) * (compression.tasks - 1)
            again = 2.0 * values * view * rounds
            again += folds * 2.0 * clusters * vert * rows * light * n_coeffs
        product = again + (
            # the view basis: its Gram matrix, and projecting on it
            2.0 * values * (n_terms + (1 + APPROXIMATIONS) * view)
            + 2.0 * data * clusters * LBG_ITERATIONS
            # classification: folding, overlaps, and what cannot be pruned
            + (iterations - 1)
            * 2.0
            * (
                clusters * vert * rows * light * n_coeffs
                + (clusters * vert) ** 2 * rows * n_coeffs
                + TRIED_SHARE * data * clusters * vert
            )
            # a model step: mixed rows, projection on the light basis, residuals
            + steps * 2.0 * data * (vert + 2 * light)
        )
        solve = (
            steps
            * clusters
            * (
                decomposition_flops(float(vert * rows), float(n_coeffs))
                + decomposition_flops(members, float(rows * light))
            )
        )
    else:
        product = 2.0 * values * clusters * iterations + 4.0 * values * compression.n_components
        solve = 0.0
        if compression.n_components:
            solve = clusters * decomposition_flops(members, values / n_verts)
    shared = min(threads, max(1, clusters // compression.tasks))
    return {
        "tasks": float(tasks),
        "values": reads * values,
        "product_flops": product / shared,
        "solve_flops": solve / shared,
    }


def decomposition_flops(n_rows: float, n_columns: float) -> float:
    """Count the float64 operations of a row space: a Gram matrix of the shorter side, its eigen."""
    short, long = sorted((n_rows, n_columns))
    return 4.0 * short**2 * long + 20.0 * short**3


def quantise_work(
    compression: PartCompression,
    *,
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    factor_floats: int,
    n_channels: int = 1,
) -> dict[str, float]:
    """Count what writing a part's asset does: factors twice, and both read back and compared."""
    view, light, vert = compression.ranks
    if compression.method == "cta":
        rows = n_channels * view
        rebuilt = n_verts * rows * light * vert + n_verts * n_channels * n_terms * light * (
            view + n_coeffs
        )
    else:
        rebuilt = n_verts * compression.n_components * n_channels * n_terms * n_coeffs
    return {
        "floats": float(factor_floats),
        "flops": 2 * 2.0 * rebuilt + 6.0 * n_verts * n_channels * n_terms * n_coeffs,
        "textures": float(n_terms > 1),
    }


def fit_work(
    settings: FitLightSettings, *, n_texels: int, samples: FitSamples | None = None
) -> dict[str, float]:
    """Count what a fit does: lobes evaluated on cells, their Gram matrices, all samples.

    The cells of a level are at most as many as lobes move in; two evaluations a step.  A target for
    the error is taken to ask for as many lobes as it may.  Functions of other methods are evaluated
    in every piece, twice.  No ``samples`` are those of a map without a bright texel.
    """
    if settings.method != "srbf_scattered":
        functions = (settings.n_centres or 0) + (settings.sh_order or 0) ** 2
        return {
            "tasks": 1.0,
            "entries": 2.0 * projected_pieces(settings, n_texels) * (1 + functions),
            "flops": 0.0,
            "texel_flops": 0.0,
        }
    own = samples or FitSamples.unsplit(n_texels)
    lobes, rounds = min(settings.n_lobes or 0, own.moving), settings.max_iterations or 0
    levels = (
        (2 * 10 * rounds, 9 * lobes),
        (8 * rounds, 32 * lobes),
        (8 * rounds, 96 * lobes + 4096),
    )
    evaluations = [(steps, min(max(cells, 384), own.moving)) for steps, cells in levels]
    return {
        "tasks": 1.0,
        "entries": float(sum(steps * cells * lobes for steps, cells in evaluations)),
        "flops": float(sum(2 * steps * cells * lobes**2 for steps, cells in evaluations)),
        "texel_flops": 2.0 * lobes * (own.solving * lobes + 20 * own.judging),
    }


def render_work(settings: RenderSettings, *, n_verts: int, n_values: int) -> dict[str, float]:
    """Count what previews do: pixels of all pictures, and the numbers relit for each light.

    ``n_values`` are the terms of all vertices, channels included.
    """
    pictures = len(settings.cameras) + settings.turntable_frames
    lights = 1 + settings.turntable_frames
    return {
        "tasks": 1.0,
        "pixels": float(pictures * settings.width * settings.height * SAMPLES_A_SIDE**2),
        "relit": float(lights * (n_verts + n_values)),
    }


def validate_work(
    settings: ValidateSettings,
    bake: PlannedBake,
    *,
    seen: Sequence[SeenPixels],
    n_terms: int,
    n_texels: int,
    baked_bounces: bool = False,
) -> dict[str, float]:
    """Count what all chains of pictures do.

    Parameters
    ----------
    seen
        By each camera.
    n_terms
        Of the part with most.
    n_texels
        Of the environment.
    """
    pixels = sum(one.pixels for one in seen)
    verts = sum(one.vertices for one in seen)
    media = sum(one.inside for one in seen)
    turns = len(settings.rotations_deg)
    samples = float((pixels + verts) * settings.passes * settings.samples * turns)
    paths = 0.0
    if settings.reference_bounces(baked=baked_bounces):
        paths = float((pixels - media) * settings.passes * settings.paths * turns)
    inside = float(media * settings.passes * MEDIUM_PATHS * settings.paths * turns)
    cells = float(verts * 3 * bake.cube_resolution**2)
    return {
        "tasks": float(len(seen)),
        "samples": samples,
        "terms": samples * n_terms,
        "paths": paths,
        "inside_paths": inside,
        "cells": cells * bake.supersample**2,
        "cell_terms": cells * n_terms,
        "lights": float(len(seen) * turns * n_texels * bake.n_coeffs),
    }
