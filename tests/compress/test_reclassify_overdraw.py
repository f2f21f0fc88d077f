import numpy as np
import pytest

from prtbake_storage.decode.overdraw import triangle_overdraw
from prtbake_workers.compress.reclassify_overdraw import reclassify_for_overdraw
from support.grid_mesh import grid_faces

SIDE, CLUSTERS = 8, 4


@pytest.fixture
def noisy(rng):
    """Faces, labels, squared errors (verts, clusters) and weights of a ragged clustering."""
    errors = rng.random((SIDE * SIDE, CLUSTERS))
    labels = np.argmin(errors + 0.3 * rng.random(errors.shape), axis=1).astype(np.int32)
    return grid_faces(SIDE), labels, errors, 0.5 + rng.random(len(labels))


def _own(errors, labels):
    return errors[np.arange(len(labels)), labels]


def _run(noisy, budget):
    faces, labels, errors, weights = noisy
    start = float(weights @ _own(errors, labels))
    found = reclassify_for_overdraw(
        faces,
        labels,
        _own(errors, labels),
        lambda cluster, verts: errors[verts, cluster],
        weights=weights,
        most_error=(1.0 + budget) * start,
    )
    return found, start


def _slowly(noisy, budget):
    """The same search with everything counted anew before each move."""
    faces, labels, errors, weights = noisy
    labels = labels.copy()
    limit = (1.0 + budget) * float(weights @ _own(errors, labels))
    passed_over = set()
    while True:
        best, total = None, float(weights @ _own(errors, labels))
        drawn = int(triangle_overdraw(faces, labels).sum())
        for vert in range(len(labels)):
            around = {int(c) for c in labels[faces[(faces == vert).any(axis=1)]].ravel()}
            if np.count_nonzero(labels == labels[vert]) == 1:
                continue
            for cluster in sorted(around - {int(labels[vert])}):
                moved = labels.copy()
                moved[vert] = cluster
                saved = drawn - int(triangle_overdraw(faces, moved).sum())
                added = weights[vert] * (errors[vert, cluster] - errors[vert, labels[vert]])
                state = (vert, cluster, tuple(moved[faces[(faces == vert).any(axis=1)]].ravel()))
                if saved < 0 or (saved == 0 and added >= 0.0) or state in passed_over:
                    continue
                rank = -saved / added if added > 0.0 else -float(saved)
                move = (added > 0.0, rank, added, vert, cluster, state)
                if best is None or move < best:
                    best = move
        if best is None:
            return labels
        _, _, added, vert, cluster, state = best
        if added > 0.0 and total + added > limit:
            passed_over.add(state)
            continue
        labels[vert] = cluster


@pytest.mark.parametrize("budget", [0.0, 0.05, 0.5])
def test_it_finds_what_a_search_from_scratch_finds(noisy, budget):
    found, _ = _run(noisy, budget)
    np.testing.assert_array_equal(found.labels, _slowly(noisy, budget))
    assert found.n_moves > 0
    assert not np.array_equal(found.labels, noisy[1])


@pytest.mark.parametrize("budget", [0.0, 0.05, 0.5])
def test_error_and_draws_are_those_of_the_labels(noisy, budget):
    faces, labels, errors, weights = noisy
    found, start = _run(noisy, budget)
    np.testing.assert_array_equal(found.errors, _own(errors, found.labels))
    assert weights @ _own(errors, found.labels) <= (1.0 + budget) * start * (1.0 + 1e-12)
    drawn = int(triangle_overdraw(faces, found.labels).sum())
    assert int(triangle_overdraw(faces, labels).sum()) - drawn == found.saved > 0


def test_a_larger_budget_is_spent_and_saves_more(noisy):
    _, _, errors, weights = noisy
    little, start = _run(noisy, 0.0)
    much, _ = _run(noisy, 0.5)
    assert much.saved > little.saved
    assert weights @ _own(errors, much.labels) > 1.05 * start


def test_no_cluster_is_emptied():
    faces = grid_faces(4)
    labels = np.zeros(16, np.int32)
    labels[5] = 1
    errors = np.zeros((16, 2))
    found = reclassify_for_overdraw(
        faces,
        labels,
        errors[:, 0],
        lambda cluster, verts: errors[verts, cluster],
        weights=np.ones(16),
        most_error=1.0,
    )
    assert found.n_moves == 0
    labels[6] = 1
    pair = reclassify_for_overdraw(
        faces,
        labels,
        errors[:, 0],
        lambda cluster, verts: errors[verts, cluster],
        weights=np.ones(16),
        most_error=1.0,
    )
    assert np.bincount(pair.labels).tolist() == [15, 1]
