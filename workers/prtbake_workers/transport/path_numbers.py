"""The uniform numbers that paths are drawn by."""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64
from prtbake_workers.transport.hemisphere_rays import lattice

N_AXES = 6
"""Uniform numbers at a path vertex: two for the light, one to choose a component, two for the
direction, one for the roulette."""


class PathNumbers:
    """The numbers of one pass at one depth: a pattern over samples, shifted by point.

    Parameters
    ----------
    key
        Seed, pass, depth, and whatever else tells them apart.
    n_points, n_samples
        Points, and paths of each in the pass.
    """

    def __init__(self, key: list[int], n_points: int, n_samples: int) -> None:
        rng = np.random.default_rng(key)
        square, line = lattice(n_samples), (np.arange(n_samples) + 0.5) / n_samples
        self.pattern = np.concatenate(
            [
                square[rng.permutation(n_samples)],
                line[rng.permutation(n_samples), None],
                square[rng.permutation(n_samples)],
                line[rng.permutation(n_samples), None],
            ],
            axis=1,
        )
        self.shift = rng.random((n_points, N_AXES))

    def of(self, point: I64, sample: I64) -> Float64[F64, "paths axes"]:
        """Give the numbers of paths."""
        moved = self.pattern[sample] + self.shift[point]
        moved -= np.floor(moved)
        return np.minimum(moved, np.nextafter(1.0, 0.0), out=moved)
