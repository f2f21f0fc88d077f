"""Parts with two sides: every triangle twice, one copy for each side.

The vertices of a two-sided part are its surface's twice over: vertex v of the first half is vertex
v + half of the second, at the same place with the opposite normal.  So are its triangles: the
second copy has the first one's corners in reverse order, each on its other side.  The winding of a
copy and the normals of its corners agree, so a copy is seen from the side that it faces, and with
back faces culled the other one never is.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]


def opposite_faces(
    faces: I32, vertex_ranges: Sequence[tuple[int, int]], two_sided: Sequence[bool]
) -> I64:
    """Give the copy on the other side of each triangle, (tris,); -1 where there is none.

    Parameters
    ----------
    faces
        (tris, 3) corners, in any order of the parts.
    vertex_ranges, two_sided
        Of each part.

    Raises
    ------
    ValueError
        Triangles of a two-sided part that are not copies of each other.
    """
    opposite = np.full(len(faces), -1, np.int64)
    for index, ((start, stop), both) in enumerate(zip(vertex_ranges, two_sided, strict=True)):
        if not both:
            continue
        own = np.flatnonzero((faces[:, 0] >= start) & (faces[:, 0] < stop))
        half, odd = divmod(stop - start, 2)
        first, second = np.split(own, [len(own) // 2])
        turned = start + (faces[first][:, ::-1].astype(np.int64) - start + half) % (2 * half or 1)
        if odd or turned.shape != (len(second), 3) or (turned != faces[second]).any():
            raise ValueError(f"parts/{index}/two_sided: its triangles are not there twice over")
        opposite[first], opposite[second] = second, first
    return opposite
