"""Predicted memory of a block of bounces: rays, then means over neighbours."""

import pytest

from prtbake_workers.planning.bounce_memory import bounce_memory_bytes
from prtbake_workers.planning.cost import CHILD_BYTES

SPHERE = {"n_verts": [10_242, 900], "part_terms": [15, 1], "n_channels": 1, "n_columns": 162}


def test_means_over_neighbours_hold_another_transfer():
    """Measured with few rays, 745 MB: bounces of a glossy sphere on a plane that were averaged."""
    seen = {"hit_share": 0.38, "n_rays": [22, 10]}
    smoothed = bounce_memory_bytes(**SPHERE, **seen, smoothed=[True, False])
    assert smoothed == pytest.approx(745e6, rel=0.1)
    # negative twin: parts that are not averaged, and a diffuse one, hold no complex terms
    assert bounce_memory_bytes(**SPHERE, **seen) < 0.9 * smoothed
    diffuse = SPHERE | {"part_terms": [1, 1]}
    assert bounce_memory_bytes(**diffuse, **seen, smoothed=[True, True]) == (
        bounce_memory_bytes(**diffuse, **seen)
    )


def test_rays_outweigh_means_where_they_are_many():
    many = {"hit_share": 0.38, "n_rays": [256, 256]}
    assert bounce_memory_bytes(**SPHERE, **many, smoothed=[True, True]) == (
        bounce_memory_bytes(**SPHERE, **many)
    )


def test_radiance_is_of_vertices_that_see_a_surface():
    one = {"n_verts": [2000], "part_terms": [1], "n_channels": 1, "n_columns": 162}
    none, few, all_of_them = (
        bounce_memory_bytes(**one, n_rays=[8], hit_share=share) for share in (0.0, 0.06, 1.0)
    )
    assert none == CHILD_BYTES + 4 * 2000 * 162 * 4 + 4 * 2000 * 8
    # radiance and what is added to it in float32, and three corners a hit
    assert all_of_them - none == 8 * 2000 * 8 * 162 + 24 * 2000 * 8
    assert 0.3 < (few - none) / (all_of_them - none) < 0.5
