import sys
from threading import Event
from types import ModuleType

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from prtbake_workers.compress.parallel import (
    _pools,
    blas_threads,
    each_in_order,
    map_in_order,
    same_bytes_on_any_threads,
)


def threads_of_blas():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_blas_keeps_to_one_thread_and_gets_its_own_back():
    with threadpool_limits(limits=2, user_api="blas"):
        assert blas_threads() == 2
        with same_bytes_on_any_threads():
            assert threads_of_blas() == {1}
        assert threads_of_blas() == {2}
        assert blas_threads() == 2


@pytest.mark.parametrize("mapping", [map_in_order, each_in_order])
def test_results_come_in_the_items_order_whoever_ends_first(mapping):
    second_ended, ended = Event(), []

    def work(n):
        if n == 0:
            assert second_ended.wait(20.0)
        ended.append(n)
        if n == 1:
            second_ended.set()
        return n * n

    with threadpool_limits(limits=2, user_api="blas"), same_bytes_on_any_threads():
        found = list(mapping(work, range(9)))
    assert ended[0] == 1
    assert found == [n * n for n in range(9)]


@pytest.mark.parametrize("threads", [1, 2])
def test_results_taken_one_by_one_are_not_made_far_ahead(threads):
    begun = []

    def work(n):
        begun.append(n)
        return n

    with threadpool_limits(limits=threads, user_api="blas"), same_bytes_on_any_threads():
        for n, found in enumerate(each_in_order(work, range(30))):
            assert found == n
            # the one taken and one a thread; far from all thirty
            assert len(begun) <= n + 1 + threads
    assert sorted(begun) == list(range(30))


def test_what_one_item_raises_is_raised():
    with threadpool_limits(limits=2, user_api="blas"), same_bytes_on_any_threads():
        found = each_in_order(lambda n: 1 // (3 - n), range(9))
        assert [next(found) for _ in range(3)] == [0, 0, 1]
        with pytest.raises(ZeroDivisionError):
            next(found)


def test_libraries_are_looked_for_anew_once_a_module_was_loaded(monkeypatch):
    before = _pools()
    assert _pools() is before
    monkeypatch.setitem(sys.modules, "one_more", ModuleType("one_more"))
    assert _pools() is not before


def test_a_module_in_the_place_of_another_is_a_change(monkeypatch):
    monkeypatch.setitem(sys.modules, "one", ModuleType("one"))
    before, n_modules = _pools(), len(sys.modules)
    monkeypatch.delitem(sys.modules, "one")
    monkeypatch.setitem(sys.modules, "other", ModuleType("other"))
    assert len(sys.modules) == n_modules
    assert _pools() is not before
