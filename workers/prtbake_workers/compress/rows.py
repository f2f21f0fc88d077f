"""Rows of a signal, one a vertex, that need not lie in memory.

An array is such rows.  So is what reads them from elsewhere, or makes them, when they are asked
for: a fit asks for a chunk, or for the vertices of a cluster, and holds no more than that.
"""

from math import prod
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from prtbake_workers.arrays import F32, Float32


@runtime_checkable
class Rows(Protocol):
    """float32 rows of any shape; as many axes as an array of them all would have."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Of all rows together, vertices first."""
        ...

    @property
    def nbytes(self) -> int:
        """Bytes that an array of them all would have."""
        ...

    def __len__(self) -> int:
        """Vertices."""
        ...

    def __getitem__(self, verts: slice | NDArray[Any], /) -> NDArray[Any]:
        """Return the rows of a slice without a step, or of indices in any order, as an array."""
        ...


class FlatRows:
    """The rows of others, each as one axis."""

    def __init__(self, rows: Rows) -> None:
        self.rows = rows
        self.shape = (len(rows), prod(rows.shape[1:]))
        self.nbytes = rows.nbytes

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, verts: slice | NDArray[Any], /) -> Float32[F32, "verts dims"]:
        """Return the rows of some vertices."""
        return self.rows[verts].reshape(-1, self.shape[1])


def flat(rows: Rows) -> Rows:
    """Return rows with one axis each: a view of an array, or what reads them so."""
    return rows.reshape(len(rows), -1) if isinstance(rows, np.ndarray) else FlatRows(rows)
