"""Every method takes coherence and a budget of overdraw."""

from dataclasses import dataclass

import numpy as np
import pytest

from prtbake_storage.decode.overdraw import average_overdraw
from prtbake_workers.compress.coherence import coherence_of
from prtbake_workers.compress.methods import Fit, compress
from support.grid_mesh import sphere_faces
from synthetic_transfer import equal_area_directions


@dataclass(frozen=True)
class Sizes:
    n_clusters: int = 20
    ranks: tuple[int, int, int] = (4, 12, 5)
    n_components: int = 3


@pytest.mark.parametrize("method", ["vq", "cpca", "cta"])
def test_a_budget_is_spent_on_fewer_draws(method, glossy):
    directions = equal_area_directions(len(glossy))
    faces = sphere_faces(directions)
    plain, moved, coherent = (
        compress(method, glossy, Sizes(), Fit(seed=1, max_iterations=6, faces=faces, **given)).model
        for given in ({}, {"overdraw_budget": 0.05}, {"coherence": coherence_of(directions, 3.0)})
    )
    assert average_overdraw(faces, moved.labels) < average_overdraw(faces, plain.labels)
    assert moved.squared_error_ratio <= 1.05 * plain.squared_error_ratio * (1.0 + 1e-5)
    gap = (moved.reconstruct().reshape(glossy.shape) - glossy).astype(float)
    ratio = np.sum(gap**2) / np.sum(glossy.astype(float) ** 2)
    # float32 factors, sums in float64
    assert moved.squared_error_ratio == pytest.approx(ratio, rel=1e-4)
    assert not np.array_equal(coherent.labels, plain.labels)


def test_one_cluster_is_drawn_once_whatever_the_budget(glossy):
    faces = sphere_faces(equal_area_directions(len(glossy)))
    fit = Fit(seed=1, max_iterations=2, faces=faces, overdraw_budget=0.05)
    model = compress("pca", glossy, Sizes(), fit).model
    assert average_overdraw(faces, model.labels) == 1.0
