"""Work cut up among threads so that its result does not depend on how many there are.

One thread or two changes the last bits of a matrix product, and BLAS takes what the machine lets it
have.  So a compression keeps BLAS on one thread and spreads whole clusters, or whole pieces of the
data, over as many threads as BLAS would have used: faster on small products, no worse on large
ones, and the same bytes on any machine of one kind.
"""

import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import TypeVar

from threadpoolctl import ThreadpoolController

Item = TypeVar("Item")
Result = TypeVar("Result")
_THREADS: ContextVar[int] = ContextVar("threads", default=1)


def blas_threads() -> int:
    """Return how many threads the BLAS library is allowed."""
    pools = [pool["num_threads"] for pool in _pools().info() if pool["user_api"] == "blas"]
    return max(pools, default=1)


@contextmanager
def same_bytes_on_any_threads() -> Iterator[None]:
    """Keep BLAS on one thread, and let `map_in_order` use those that it had."""
    token = _THREADS.set(max(blas_threads(), _THREADS.get()))
    try:
        with _pools().limit(limits=1, user_api="blas"):
            yield
    finally:
        _THREADS.reset(token)


def map_in_order(work: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """Return ``work`` of each item, in the items' order."""
    items = list(items)
    n_threads = min(_THREADS.get(), len(items))
    if n_threads <= 1:
        return [work(item) for item in items]
    with ThreadPoolExecutor(n_threads) as pool:
        return list(pool.map(work, items))


def each_in_order(work: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """Yield ``work`` of each item, in the items' order; about one a thread is held meanwhile."""
    items = list(items)
    n_threads = min(_THREADS.get(), len(items))
    if n_threads <= 1:
        yield from map(work, items)
        return
    with ThreadPoolExecutor(n_threads) as pool:
        ahead = deque(pool.submit(work, item) for item in items[:n_threads])
        for item in items[n_threads:]:
            done = ahead.popleft().result()
            ahead.append(pool.submit(work, item))
            yield done
        while ahead:
            yield ahead.popleft().result()


def _pools() -> ThreadpoolController:
    """Find the libraries that have threads: anew only when there may be others of them."""
    return _pools_beside(tuple(sys.modules))


@lru_cache(maxsize=1)
def _pools_beside(_modules: tuple[str, ...]) -> ThreadpoolController:
    # looking through all loaded libraries takes milliseconds, more than many a small fit
    return ThreadpoolController()
