"""Count what compression does beyond one plain fit: trials, classification by error, moves.

How often it does so depends on what it finds.  The numbers here were counted on baked transfer of
teapots and spheres of 600 to 10,000 vertices.
"""

from prtbake_storage.contract.settings import CompressSettings
from prtbake_workers.compress.less_overdraw import ROUNDS
from prtbake_workers.compress.to_error import TRIAL_ITERATIONS
from prtbake_workers.planning.expected_sizes import expected_sizes
from prtbake_workers.planning.presets import PartCompression
from prtbake_workers.planning.stage_work import compress_work, decomposition_flops

TRIALS, VQ_TRIALS = 2.4, 4.0
"""Fits of few iterations before the one in full: 1 to 3 are counted.  A trial of vector
quantisation is a fit in full, the last of 3 to 5 is the result."""

FIRST_PASSES, FEWER_PASSES = 10.0, 0.6
"""Passes of classification by error with one component, and by how many each more has fewer."""

PASS_VERTS, PASS_POWER = 4000, 0.25
"""Vertices of a part of so many, and by which power more take more.  59, 84 and 102 are counted up
to 16 components at 2,000, 4,700 and 10,000 vertices, where these make 66, 81 and 99."""

ADAPTIVE_PASSES = 5.0
"""After them: 3 to 5."""

REFITTED = 0.8
"""Of the clusters, that a pass changes."""


def searched_work(
    compression: PartCompression,
    settings: CompressSettings,
    *,
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    n_channels: int = 1,
) -> dict[str, float]:
    """Count what compressing a part is expected to do by settings of any kind.

    ``places`` are vertices whose distance on the mesh is asked for, ``moves`` those that are tried
    in their neighbours' clusters.
    """
    size = {
        "n_verts": n_verts,
        "n_terms": n_terms,
        "n_coeffs": n_coeffs,
        "n_channels": n_channels,
    }
    own = expected_sizes(compression, settings.max_error, **size)
    rounds = settings.max_iterations
    fits = [(1.0, rounds)]
    if settings.max_error is not None:
        few = min(rounds, TRIAL_ITERATIONS)
        fits = [(TRIALS, few), (1.0, rounds)]
        if own.method == "vq":
            fits = [(VQ_TRIALS, rounds)]
        if own.method == "pca":  # a trial takes more or fewer of the components found once
            fits = [(TRIALS, few)]
    plain = compress_work(own, **size, iterations=rounds, threads=settings.threads)
    found = plain | {"product_flops": 0.0, "solve_flops": 0.0, "places": 0.0, "moves": 0.0}
    shared = min(settings.threads, own.n_clusters, n_verts)
    for times, iterations in fits:
        fit = compress_work(own, **size, iterations=iterations, threads=settings.threads)
        product, solve = fit["product_flops"], fit["solve_flops"]
        more_product, more_solve = _by_error(own, iterations, **size)
        product += more_product / shared
        solve += more_solve / shared
        if settings.coherence:
            again = _classified_by_error(own)
            passes = passes_by_error(own.n_components, iterations, n_verts=n_verts) if again else ()
            found["places"] += times * n_verts * (iterations + sum(passes))
        if settings.overdraw_budget is not None:
            refits = 1 if own.method == "cta" else ROUNDS
            found["moves"] += times * n_verts * refits
            if own.method != "cta" and own.n_components:
                solve += refits * _components(own, **size) / shared
        found["product_flops"] += times * product
        found["solve_flops"] += (1.0 if own.method == "pca" else times) * solve
    return found


def passes_by_error(n_components: int, most: int, *, n_verts: int) -> list[float]:
    """Give the passes of iterative classification with each number of components."""
    share = (n_verts / PASS_VERTS) ** PASS_POWER
    wanted = (FIRST_PASSES - FEWER_PASSES * rank for rank in range(1, n_components + 1))
    return [min(float(most), share * max(1.0, one)) for one in wanted]


def _classified_by_error(own: PartCompression) -> bool:
    return own.method == "cpca" and own.classification != "static" and own.n_components > 0


def _by_error(
    own: PartCompression,
    most: int,
    *,
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    n_channels: int,
) -> tuple[float, float]:
    """Count the products and decompositions of classification by error."""
    if not _classified_by_error(own):
        return 0.0, 0.0
    values = float(n_verts * n_channels * n_terms * n_coeffs)
    passes = passes_by_error(own.n_components, most, n_verts=n_verts)
    product = sum(
        # every cluster's mean and components, then what these leave
        number * (2.0 * values * own.n_clusters * (1 + rank) + 4.0 * values * rank)
        for rank, number in enumerate(passes, start=1)
    )
    refits = REFITTED * sum(passes)
    if own.classification == "adaptive":
        more = min(float(most), ADAPTIVE_PASSES)
        product += more * 2.0 * values * (own.n_clusters + 2) * (1 + own.n_components)
        refits += 1.0 + REFITTED * more
    solve = refits * _components(
        own, n_verts=n_verts, n_terms=n_terms, n_coeffs=n_coeffs, n_channels=n_channels
    )
    return product, solve


def _components(
    own: PartCompression, *, n_verts: int, n_terms: int, n_coeffs: int, n_channels: int
) -> float:
    """Count the decompositions that find all clusters' components once."""
    clusters = min(own.n_clusters, n_verts)
    dims = float(n_channels * n_terms * n_coeffs)
    return clusters * decomposition_flops(n_verts / clusters, dims)
