from itertools import product

import numpy as np
import pytest

from prtbake_workers.compress.rank_allocation import allocate_ranks


def _gains(rng, n_clusters, most=6):
    return [np.sort(rng.exponential(size=rng.integers(0, most)))[::-1] for _ in range(n_clusters)]


def _won(gains, ranks):
    return sum(own[:rank].sum() for own, rank in zip(gains, ranks, strict=True))


def test_where_all_cost_alike_the_largest_gains_are_taken(rng):
    gains = _gains(rng, 20)
    ranks, price = allocate_ranks(gains, np.full(20, 3.0), 3.0 * 17 + 2.9)
    largest = np.sort(np.concatenate(gains))[::-1]
    assert ranks.sum() == 17
    assert _won(gains, ranks) == pytest.approx(largest[:17].sum())
    assert price == pytest.approx(largest[16] / 3.0)


def test_beside_every_choice_that_fits(rng):
    """The greedy one misses the best by less than the component that no longer fitted."""
    for _ in range(20):
        gains = _gains(rng, 4, most=4)
        costs = rng.uniform(1.0, 3.0, 4)
        ranks, _ = allocate_ranks(gains, costs, 9.0)
        assert costs @ ranks <= 9.0
        best = max(
            _won(gains, choice)
            for choice in product(*(range(len(own) + 1) for own in gains))
            if costs @ choice <= 9.0
        )
        most = max((own[0] for own in gains if len(own)), default=0.0)
        assert best - most <= _won(gains, ranks) <= best + 1e-12


def test_what_is_left_out_would_not_pay_more_than_the_price(rng):
    gains, costs = _gains(rng, 30), rng.uniform(10.0, 200.0, 30)
    ranks, price = allocate_ranks(gains, costs, 4000.0)
    left = 4000.0 - costs @ ranks
    for own, cost, rank in zip(gains, costs, ranks, strict=True):
        if rank:
            assert own[rank - 1] / cost >= price
        if rank < len(own) and cost <= left:
            pytest.fail("there was storage for another component")


def test_a_cheap_cluster_comes_first_at_equal_gain():
    gains = [np.array([1.0, 1.0]), np.array([1.0, 1.0])]
    assert allocate_ranks(gains, np.array([10.0, 5.0]), 10.0).ranks.tolist() == [0, 2]
    assert allocate_ranks(gains, np.array([5.0, 10.0]), 10.0).ranks.tolist() == [2, 0]


def test_storage_for_all_costs_nothing_and_zero_gains_are_not_taken():
    ranks, price = allocate_ranks([np.array([2.0, 1.0, 0.0]), np.zeros(0)], np.ones(2), 100.0)
    assert ranks.tolist() == [2, 0]
    assert price == 0.0
    assert allocate_ranks([np.zeros(0)], np.ones(1), 5.0).ranks.tolist() == [0]
