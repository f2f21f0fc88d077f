"""How often a triangle is drawn when a mesh is rendered a cluster of vertices at a time.

A renderer that loads the data of one cluster draws all triangles with a corner in it, and takes
corners of other clusters as black ([Chen2005]_ section 4.1).  So a triangle is drawn once for every
cluster that its corners lie in; where clusters are drawn in groups whose data fit together, once
for every group.
"""

import numpy as np
from numpy.typing import NDArray

I32 = NDArray[np.int32]


def triangle_overdraw(faces: I32, labels: I32) -> I32:
    """Return (tris,) how many clusters the corners of each triangle lie in: 1, 2 or 3.

    Parameters
    ----------
    faces
        (tris, 3) corners of each triangle, indices into ``labels``.
    labels
        (verts,) cluster of each vertex.  For draws by supercluster give that of each vertex.

    References
    ----------
    [Sloan2003]_ section 5.
    """
    a, b, c = labels[faces].T
    drawn: I32 = (1 + (b != a) + ((c != a) & (c != b))).astype(np.int32)
    return drawn


def average_overdraw(faces: I32, labels: I32) -> float:
    """Return triangles drawn over triangles ([Chen2005]_ eq. 8): 1 to 3, and 1 without triangles.

    Parameters are those of `triangle_overdraw`.
    """
    if len(faces) == 0:
        return 1.0
    return float(triangle_overdraw(faces, labels).mean(dtype=np.float64))
