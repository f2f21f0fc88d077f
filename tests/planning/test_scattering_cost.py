"""Runs of rows, and what they are predicted to cost."""

from itertools import pairwise

import pytest

from prtbake_workers.planning.cluster_limit import ClusterLimit
from prtbake_workers.planning.scattering_cost import (
    MOST_RUNS,
    ROWS_PER_TASK,
    product_work,
    row_runs,
    rows_memory_bytes,
    rows_work,
    scattering_memory_bytes,
)

COARSE, FINE = ClusterLimit(1.0, 1e-5, 200.0), ClusterLimit(0.2, 1e-6, 600.0)


@pytest.mark.parametrize("n_verts", [1, 7, ROWS_PER_TASK, ROWS_PER_TASK + 1, 10**6, 10**7])
def test_runs_hold_every_row_once_and_are_of_a_length(n_verts):
    runs = row_runs(n_verts)
    assert (runs[0][0], runs[-1][1]) == (0, n_verts)
    assert all(one[1] == other[0] for one, other in pairwise(runs))
    lengths = [stop - start for start, stop in runs]
    assert 1 <= min(lengths) <= max(lengths) <= min(lengths) + 1
    assert len(runs) <= MOST_RUNS
    assert row_runs(0) == []
    assert max(lengths) <= ROWS_PER_TASK or len(runs) == MOST_RUNS


def test_entries_are_what_costs():
    verts = {0: 30_000, 2: 10_000}
    coarse, fine = {0: COARSE, 2: COARSE}, {0: FINE, 2: COARSE}
    few, many = (rows_work(verts, limits) for limits in (coarse, fine))
    assert many["entries"] - few["entries"] == pytest.approx(30_000 * 400.0)
    assert few["tasks"] == len(row_runs(30_000)) + len(row_runs(10_000))
    # every run sorts its whole part
    assert few["vertices"] == sum(len(row_runs(n)) * n for n in verts.values())
    assert not any(rows_work(verts, {}).values())
    options = {"times": 3, "n_channels": 3, "n_coeffs": 162}
    slow, quick = (
        product_work(verts, limits, **options)["sparse_flops"] for limits in (fine, coarse)
    )
    assert slow == pytest.approx((3.0 * 30 + 10) / 40 * quick)
    channels = {0: 3, 2: 3}
    # the largest run, and the rows of all parts
    assert rows_memory_bytes(verts, coarse, channels) == rows_memory_bytes(
        {0: 30_000}, {0: COARSE}, channels
    )
    more = scattering_memory_bytes(verts, coarse, channels, n_columns=64)
    assert more > scattering_memory_bytes({0: 30_000}, {0: COARSE}, channels, n_columns=64)
    assert scattering_memory_bytes(verts, {}, channels, n_columns=64) == 0
