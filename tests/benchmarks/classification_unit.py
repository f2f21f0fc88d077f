"""The unit of compressions and bakes: the one product that CTA's classification cannot do without.

All vertices' (r_view coeffs) rows by the folded bases of all clusters.  It is timed in pieces
between those of what it is the unit of, and both as means over the same span: the speed of a
shared machine changes by the minute, and that of a product by more than that of rays.
"""

import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import cache
from multiprocessing import get_context
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

PIECES = 8
"""That the rows are cut into; a process times one of them at a time."""

SEED = 0


class Shape(NamedTuple):
    """Of the product: vertices, view rank times coefficients, clusters times vertex rank."""

    n_verts: int
    depth: int
    width: int

    @property
    def piece(self) -> tuple[int, int, int]:
        return self.n_verts // PIECES, self.depth, self.width


@contextmanager
def unit_aside(shape: Shape) -> Iterator["UnitAside"]:
    """Time pieces of the product in a process of its own, whose memory is not that of the work."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        pool.submit(seconds_of_piece, shape.piece).result()  # touches the pages
        yield UnitAside(shape, pool)


class UnitAside:
    """Pieces of the product as they were timed, see `unit_aside`."""

    def __init__(self, shape: Shape, pool: ProcessPoolExecutor) -> None:
        self.shape, self._pool = shape, pool
        self.pieces: list[float] = []

    def time_piece(self) -> float:
        """Time a piece, and give the seconds to leave out of the work's own."""
        start = time.perf_counter()
        self.pieces.append(self._pool.submit(seconds_of_piece, self.shape.piece).result())
        return time.perf_counter() - start

    @property
    def measured(self) -> dict[str, float]:
        """Seconds of the whole product by the mean of the pieces, and its speed."""
        n_rows, depth, width = self.shape.piece
        piece = float(np.mean(self.pieces))
        return {
            "unit_seconds": piece * self.shape.n_verts / n_rows,
            "unit_gflops": 2e-9 * n_rows * depth * width / piece,
        }


def seconds_of_piece(shape: tuple[int, int, int]) -> float:
    """Time one product."""
    left, right, out = _operands(shape)
    start = time.perf_counter()
    np.matmul(left, right, out=out)
    return time.perf_counter() - start


@cache
def _operands(shape: tuple[int, int, int]) -> tuple[NDArray[np.float32], ...]:
    n_rows, depth, width = shape
    rng = np.random.default_rng(SEED)
    return (
        rng.standard_normal((n_rows, depth), dtype=np.float32),
        rng.standard_normal((depth, width), dtype=np.float32),
        np.empty((n_rows, width), np.float32),
    )
