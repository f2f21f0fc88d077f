"""A glossy part with factors of the other kind: means, and components where the method has them."""

from dataclasses import replace

import numpy as np

from prtbake_storage.decode.asset import FACTORS, Part


def with_means(part: Part, method: str, n_coeffs: int, rng: np.random.Generator) -> Part:
    """The same surface, view columns, clusters and weights with random means of every term.

    Terms are as many as view columns, each a column of its own, as `Part` has it for means.
    """
    n_pcs = 2 if "components" in FACTORS[method] else 0
    n_clusters = 1 if method == "pca" else part.n_clusters
    dims = part.n_channels * part.n_view * n_coeffs

    def random(*shape: int) -> np.ndarray:
        return rng.normal(size=shape).astype(np.float32)

    ranks = np.tile(np.int32([part.n_view, n_coeffs, n_pcs]), (n_clusters, 1))
    return replace(
        part, method=method, light_bases=None, dual_bases=None, ranks=ranks,
        labels=(part.labels % n_clusters).astype(np.int32), weights=part.weights[:, :n_pcs],
        means=random(n_clusters, dims), components=random(n_clusters, n_pcs, dims),
        view_basis=np.eye(part.n_view, dtype=np.float32),
    )  # fmt: skip
