import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prtbake_workers.planning.frontier import pareto_frontier

# few values, so that ties of one number and of both are common
SMALL = st.lists(st.tuples(st.integers(0, 4), st.integers(0, 4)), max_size=12)
LARGE = st.lists(st.tuples(st.floats(0, 1e9), st.floats(0, 1.0)), max_size=12)


def brute_force(points):
    """Every point that no other beats, by comparing all with all."""
    return {
        place
        for place, (cost, error) in enumerate(points)
        if not any(
            c <= cost and e <= error and (c < cost or e < error) for c, e in points
        )
    }  # fmt: skip


@given(st.one_of(SMALL, LARGE))
def test_it_is_what_comparing_all_with_all_finds(points):
    costs, errors = [p[0] for p in points], [p[1] for p in points]
    found = pareto_frontier(costs, errors)
    assert set(found) == brute_force(points)
    assert len(found) == len(set(found))
    # by rising cost, and the error falls
    assert [costs[i] for i in found] == sorted(costs[i] for i in found)
    assert [errors[i] for i in found] == sorted((errors[i] for i in found), reverse=True)


def test_equal_points_stand_on_it_together():
    assert pareto_frontier([2, 1, 2, 3], [1, 5, 1, 1]) == [1, 0, 2]
    # negative twin: a hair more, and one beats the other
    assert pareto_frontier([2, 1, 2, 3], [1, 5, np.nextafter(1, 2), 1]) == [1, 0]


def test_no_point_and_one():
    assert pareto_frontier([], []) == []
    assert pareto_frontier([3.0], [0.0]) == [0]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_refused(value):
    with pytest.raises(ValueError, match="error of point 1"):
        pareto_frontier([1.0, 2.0], [1.0, value])
    with pytest.raises(ValueError, match="cost of point 0"):
        pareto_frontier([value, 2.0], [1.0, 1.0])


def test_lengths_must_agree():
    with pytest.raises(ValueError, match="2 costs and 1 errors"):
        pareto_frontier([1.0, 2.0], [1.0])
