"""Groups of vertices with similar normals."""

import numpy as np
import pytest

from prtbake_workers.transport.directions import cube_directions
from prtbake_workers.transport.projection import plan_projection

CUBE = cube_directions(16)


def random_normals(rng, n):
    normals = rng.normal(size=(n, 3))
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


@pytest.mark.parametrize("n_verts", [1, 2, 40, 3000])
def test_no_visible_direction_is_left_out(n_verts, rng):
    normals = random_normals(rng, n_verts)
    plan = plan_projection(normals, CUBE.directions, 16)
    for group in plan.groups:
        cosines = (normals[group.vertices] @ CUBE.directions.T).astype(np.float32)
        above = np.flatnonzero((cosines > 0).any(axis=0))
        assert np.isin(above, group.directions).all()
    members = np.concatenate([group.vertices for group in plan.groups])
    np.testing.assert_array_equal(np.sort(members), np.arange(n_verts))


def test_padding_is_bounded_and_smaller_with_more_terms(rng):
    normals = random_normals(rng, 3000)
    shares = [plan_projection(normals, CUBE.directions, terms).dense_share for terms in (1, 16)]
    assert 0.5 < shares[1] < 0.68
    assert shares[1] <= shares[0] < 1.0


def test_flat_patch_needs_one_hemisphere():
    normals = np.tile([0.0, 1.0, 0.0], (100, 1))
    plan = plan_projection(normals, CUBE.directions, 1)
    assert len(plan.groups) == 1
    assert plan.dense_share == pytest.approx(0.5, abs=0.01)


def test_a_cone_too_narrow_would_lose_directions(rng):
    """The check above can fail: half the members' cone loses directions."""
    normals = random_normals(rng, 500)
    axis = np.array([0.0, 1.0, 0.0])
    members = normals[normals @ axis > np.cos(0.5)]
    rows = np.flatnonzero(CUBE.directions @ axis > -np.sin(0.25))
    above = np.flatnonzero((members @ CUBE.directions.T > 0).any(axis=0))
    assert not np.isin(above, rows).all()


def test_vertices_without_normal_are_in_no_group(rng):
    normals = random_normals(rng, 10)
    normals[3] = 0.0
    normals[7] = np.nan
    plan = plan_projection(normals, CUBE.directions, 4)
    members = np.sort(np.concatenate([group.vertices for group in plan.groups]))
    np.testing.assert_array_equal(members, [0, 1, 2, 4, 5, 6, 8, 9])
    nothing = plan_projection(np.zeros((3, 3)), CUBE.directions, 4)
    assert nothing.groups == ()
    assert nothing.dense_share == 0.0


def test_chunks_cover_the_groups_in_order(rng):
    plan = plan_projection(random_normals(rng, 300), CUBE.directions, 16)
    chunks = list(plan.chunks(20_000))
    assert all(len(c.vertices) * len(c.directions) <= 20_000 for c in chunks)
    np.testing.assert_array_equal(
        np.concatenate([c.vertices for c in chunks]),
        np.concatenate([g.vertices for g in plan.groups]),
    )
    one_each = list(plan.chunks(1))
    assert all(len(c.vertices) == 1 for c in one_each)
