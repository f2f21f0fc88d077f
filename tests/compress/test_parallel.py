import sys
from types import ModuleType

import numpy as np
from threadpoolctl import threadpool_info, threadpool_limits

from prtbake_workers.compress.parallel import (
    _pools,
    blas_threads,
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


def test_results_come_in_the_items_order():
    with threadpool_limits(limits=2, user_api="blas"), same_bytes_on_any_threads():
        found = map_in_order(lambda n: np.full(n, n).sum(), range(9))
    assert found == [n * n for n in range(9)]


def test_libraries_are_looked_for_anew_once_a_module_was_loaded(monkeypatch):
    before = _pools()
    assert _pools() is before
    monkeypatch.setitem(sys.modules, "one_more", ModuleType("one_more"))
    assert _pools() is not before
