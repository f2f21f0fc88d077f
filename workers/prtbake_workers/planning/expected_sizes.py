"""What sizes a compression to an error is expected to end at, before any fit.

The numbers that factors hold grow as a power of one over the error.  Measured on baked transfer of
teapots and spheres, diffuse and glossy, in 162 and 642 functions, at 0.2 to 0.001.
"""

from dataclasses import replace

from prtbake_workers.planning.cost import PartCost, factor_floats, part_cost
from prtbake_workers.planning.presets import PartCompression, PlannedBake

AT_ONE_PERCENT = {"cta": 0.47, "cpca": 0.55, "pca": 0.55, "vq": 3.4}
"""Numbers of the factors that leave a hundredth, over those that a search starts from."""

POWER = {"cta": 0.57, "cpca": 0.6, "pca": 0.6, "vq": 1.45}
"""By which they grow where the error falls."""

OFF_BY, VQ_OFF_BY = 2.5, 6.0
"""Factor that scenes are away from these, either way; the latter of vector quantisation."""

STEPS = 40
"""Of the bisection for the scale."""


def expected_sizes(
    compression: PartCompression,
    max_error: float | None,
    *,
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    n_channels: int = 1,
) -> PartCompression:
    """Scale what the method's search scales; the sizes themselves where no error is asked for.

    The view rank, which a search chooses by itself, stays.
    """
    if max_error is None:
        return compression
    dims = n_channels * n_terms * n_coeffs
    own = {
        "n_verts": n_verts,
        "n_terms": n_terms,
        "n_coeffs": n_coeffs,
        "n_channels": n_channels,
    }

    def at(scale: float) -> PartCompression:
        def of(size: int, most: int) -> int:
            return max(1, min(most, round(size * scale)))

        view, light, vert = compression.ranks
        match compression.method:
            case "vq":
                return replace(compression, n_clusters=of(compression.n_clusters, n_verts))
            case "cta":
                ranks = view, of(light, n_coeffs), of(vert, min(n_verts, dims))
                return replace(compression, ranks=ranks)
        most = min(n_verts, dims)
        return replace(compression, n_components=of(compression.n_components, most))

    method = compression.method
    wanted = factor_floats(compression, **own)
    wanted *= AT_ONE_PERCENT[method] * (0.01 / max_error) ** POWER[method]
    low, high = 1e-3, 1e3
    for _ in range(STEPS):
        middle = (low * high) ** 0.5
        if factor_floats(at(middle), **own) < wanted:
            low = middle
        else:
            high = middle
    return at(high)


def expected_cost(
    bake: PlannedBake,
    compression: PartCompression,
    max_error: float | None,
    *,
    n_verts: int,
    n_terms: int,
    n_channels: int = 1,
) -> PartCost:
    """Predict a part's cost at the sizes that are expected; its memory is that of the larger."""
    size = {"n_verts": n_verts, "n_terms": n_terms, "n_channels": n_channels}
    start = part_cost(bake, compression, **size)
    own = expected_sizes(compression, max_error, **size, n_coeffs=bake.n_coeffs)
    found = part_cost(bake, own, **size)
    most = max(start.compress_memory_bytes, found.compress_memory_bytes)
    return replace(found, compress_memory_bytes=most)
