"""How far gzip packs an array, as files do it: shuffled bytes, chunk by chunk."""

import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

CHUNK_BYTES = 1 << 18
LEVEL = 4
MOST_CHUNKS = 8
"""Packed of one array; the rest are taken to pack as these, spread evenly over it, do."""


def packed_bytes(array: NDArray[Any]) -> int:
    """Give the bytes that an array takes in a file, its header left out.

    Rows of the first axis are cut into chunks of about `CHUNK_BYTES`.
    """
    if array.size == 0:
        return 0
    rows = max(1, CHUNK_BYTES // max(1, array[:1].nbytes))
    starts = range(0, len(array), rows)
    step = max(1, -(-len(starts) // MOST_CHUNKS))
    chosen = [array[start : start + rows] for start in starts[::step]]
    packed = sum(len(zlib.compress(_shuffled(chunk), LEVEL)) + 4 for chunk in chosen)
    return round(packed * len(array) / sum(len(chunk) for chunk in chosen))


def _shuffled(chunk: NDArray[Any]) -> bytes:
    """Lay all first bytes of the numbers before all second ones, and so on."""
    plain = np.ascontiguousarray(chunk)
    return plain.reshape(-1).view(np.uint8).reshape(-1, plain.itemsize).T.tobytes()
