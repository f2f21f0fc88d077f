import itertools

import numpy as np
import pytest

from prtbake_storage.decode.overdraw import average_overdraw, triangle_overdraw
from prtbake_storage.decode.superclusters import check_superclusters
from prtbake_storage.errors import SettingsError
from prtbake_workers.compress.superclusters import (
    grow_groups,
    make_superclusters,
    merge_pairs,
    registers_of_clusters,
)
from support.grid_mesh import grid_faces

SIDE = 9


def _straddling(faces, labels):
    return labels[faces[triangle_overdraw(faces, labels) > 1]]


def _best(faces, labels, needs, registers):
    """The least average overdraw of all ways to group clusters: every one is tried."""
    n_clusters = len(needs)
    least = np.inf
    for owner in itertools.product(range(n_clusters), repeat=n_clusters):
        groups = np.array(owner, np.int32)
        if np.bincount(groups, weights=needs).max() <= registers:
            least = min(least, average_overdraw(faces, groups[labels]))
    return least


def _patches(rng, n_clusters):
    """Nearest of so many random points on the grid: patches that touch."""
    places = np.stack(np.divmod(np.arange(SIDE * SIDE), SIDE), axis=1)
    seeds = places[rng.choice(len(places), n_clusters, replace=False)]
    distance = np.abs(places[:, None] - seeds).sum(axis=2)
    return np.argmin(distance, axis=1).astype(np.int32)


@pytest.mark.parametrize("seed", range(6))
def test_greedy_saves_at_least_half_of_what_can_be_saved(seed):
    rng = np.random.default_rng(seed)
    faces, labels, needs = grid_faces(SIDE), _patches(rng, 5), np.ones(5, np.int32)
    plain = average_overdraw(faces, labels)
    saved = plain - _best(faces, labels, needs, 2)
    # of pairs, the greedy matching weighs at least half of the heaviest
    for groups in (
        merge_pairs(_straddling(faces, labels), needs, 2),
        make_superclusters(faces, labels, needs, 2).of_cluster,
    ):
        assert np.bincount(groups).max() <= 2
        assert plain - average_overdraw(faces, groups[labels]) >= 0.5 * saved - 1e-12
    apart = average_overdraw(faces, np.arange(5, dtype=np.int32)[labels])
    assert plain - apart < 0.5 * saved


def test_in_a_row_of_strips_both_rules_find_the_best():
    faces = grid_faces(SIDE)
    labels = np.repeat(np.array([0, 0, 1, 1, 2, 2, 3, 3, 3], np.int32), SIDE)
    needs, sizes = np.ones(4, np.int32), np.bincount(labels)
    least = _best(faces, labels, needs, 2)
    corners = _straddling(faces, labels)
    for groups in (merge_pairs(corners, needs, 2), grow_groups(corners, needs, 2, sizes)):
        assert average_overdraw(faces, groups[labels]) == least
        assert int(groups.max()) == 1
    wrong = np.array([0, 1, 0, 1], np.int32)
    assert average_overdraw(faces, wrong[labels]) > least


def test_a_group_grows_from_the_largest_cluster_by_what_saves_most():
    """[Chen2005]_ figure 4.7, with strips: 2 is largest, 1 borders it twice, 0 once."""
    corners = np.array([[2, 1, 1], [2, 1, 2], [2, 0, 0], [1, 3, 3], [1, 3, 1]], np.int32)
    groups = grow_groups(corners, np.ones(4, np.int32), 3, np.array([1, 2, 9, 1]))
    # what joined counts too: of 2 and 1 together 3 shares two triangles, 0 only one
    assert groups[2] == groups[1] == groups[3] != groups[0]


@pytest.mark.parametrize("registers", [3, 7, 1000])
def test_index_buffers_hold_every_triangle_of_every_group(registers):
    rng = np.random.default_rng(1)
    faces, labels = grid_faces(SIDE), _patches(rng, 12)
    needs = rng.integers(1, 4, 12).astype(np.int32)
    found = make_superclusters(faces, labels, needs, registers, first_vertex=50)
    assert np.bincount(found.of_cluster, weights=needs).max() <= registers
    groups, drawn = found.of_cluster[labels], set()
    for group in range(found.n_superclusters):
        rows = found.indices[found.starts[group] : found.starts[group + 1]] - 50
        touching = {
            tuple(triangle) for triangle in faces.tolist() if group in groups[list(triangle)]
        }
        assert {tuple(row) for row in rows.tolist()} == touching
        assert len(rows) == len(touching)
        drawn |= touching
    assert drawn == {tuple(triangle) for triangle in faces.tolist()}
    assert len(found.indices) / len(faces) == pytest.approx(average_overdraw(faces, groups))
    check_superclusters("parts/0", found, faces, labels, 12, 50)
    with pytest.raises(ValueError, match="indices"):
        check_superclusters("parts/0", found, faces, labels, 12, 51)
    if found.n_superclusters > 1:
        with pytest.raises(ValueError, match=r"starts|indices"):
            check_superclusters("parts/0", found, faces, np.roll(labels, 1), 12, 50)
    else:
        assert found.indices.tolist() == (faces + 50).tolist()


def test_registers_are_counted_as_the_papers_count_them():
    # [Sloan2003] section 6.2: n' + 1 of a diffuse part
    diffuse = np.array([[1, 100, 8], [1, 100, 3]], np.int32)
    assert registers_of_clusters(diffuse, with_mean=True).tolist() == [9, 4]
    # [Chen2005] section 4.1: 36 rows, 8 components and a mean are 81 registers
    glossy = np.array([[36, 36, 8]], np.int32)
    assert registers_of_clusters(glossy, with_mean=True).tolist() == [81]
    assert 256 // 81 == 3
    assert registers_of_clusters(glossy, with_mean=False).tolist() == [72]


def test_a_cluster_that_never_fits_is_named():
    needs = np.array([2, 9, 3], np.int32)
    labels = np.repeat(np.arange(3, dtype=np.int32), 27)
    with pytest.raises(SettingsError, match="registers is 8: cluster 1 takes 9") as refused:
        make_superclusters(grid_faces(SIDE), labels, needs, 8)
    assert refused.value.pointer == "/settings/compress/registers"
    assert make_superclusters(grid_faces(SIDE), labels, needs, 9).registers == 9
