"""Equal rows get one number, in the order of the file."""

import numpy as np

from prtbake_workers.geometry.grouping import group_rows


def test_rows_are_numbered_by_first_appearance(rng):
    rows = rng.integers(0, 3, (200, 3)).astype(float)
    group, first = group_rows(rows)
    assert (rows[first][group] == rows).all()
    assert len(np.unique(rows, axis=0)) == len(first)
    assert (np.diff(first) > 0).all()
    assert (group[first] == np.arange(len(first))).all()


def test_both_zeros_are_one():
    group, _ = group_rows(np.array([[0.0, 1.0], [-0.0, 1.0], [0.0, -1.0]]))
    assert group.tolist() == [0, 0, 1]
