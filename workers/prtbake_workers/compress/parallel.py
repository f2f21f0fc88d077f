"""The same work for many clusters, on as many threads as the BLAS library would have used.

A cluster's products are too small to be worth cutting up: one cluster a thread, each with a
single-threaded BLAS, is faster, does not collapse when other programs use the machine, and gives
the same bytes for any number of threads.
"""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from threadpoolctl import threadpool_info, threadpool_limits

Item = TypeVar("Item")
Result = TypeVar("Result")


def blas_threads() -> int:
    """Return how many threads the BLAS library is allowed."""
    pools = [pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"]
    return max(pools, default=1)


def map_clusters(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return ``work`` of each item, in the items' order."""
    items = list(items)
    n_threads = blas_threads()
    if len(items) < n_threads:
        return [work(item) for item in items]
    with (
        threadpool_limits(limits=1, user_api="blas"),
        ThreadPoolExecutor(n_threads) as pool,
    ):
        return list(pool.map(work, items))
