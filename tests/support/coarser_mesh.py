"""Meshes with fewer triangles: short edges drawn together to a point, many at a time."""

import numpy as np
from scipy.sparse import coo_array

KEPT_SHARE = 0.1
"""Of the edges, the shortest first, that a round looks at."""


def coarser(
    positions: np.ndarray, faces: np.ndarray, n_faces: int
) -> tuple[np.ndarray, np.ndarray]:
    """Collapse edges of a closed mesh to their middles until ``n_faces`` triangles are left.

    Each collapse takes two triangles.  An edge is drawn together only where its ends have exactly
    two neighbours in common, which keeps the surface a manifold, and where no triangle turns over.
    """
    while len(faces) > n_faces:
        merged = _independent(positions, faces, (len(faces) - n_faces) // 2)
        if len(merged) == 0:
            raise ValueError(f"no edge of {len(faces)} triangles can be drawn together")
        kept, gone = merged.T
        positions = positions.copy()
        positions[kept] = 0.5 * (positions[kept] + positions[gone])
        target = np.arange(len(positions))
        target[gone] = kept
        faces = target[faces]
        whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
        used, corners = np.unique(faces[whole], return_inverse=True)
        positions, faces = positions[used], corners.reshape(-1, 3)
    return positions, faces.astype(np.int32)


def _independent(positions: np.ndarray, faces: np.ndarray, most: int) -> np.ndarray:
    """Return (edges, 2) short edges of which none touches what another changes."""
    n_verts = len(positions)
    ends = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges = np.unique(ends, axis=0)
    ones = np.ones(2 * len(edges), np.int32)
    pairs = np.concatenate([edges, edges[:, ::-1]]).T
    adjacent = coo_array((ones, (pairs[0], pairs[1])), (n_verts, n_verts)).tocsr()
    length = np.linalg.norm(positions[edges[:, 0]] - positions[edges[:, 1]], axis=1)
    order = np.argsort(length, kind="stable")[: max(64, int(KEPT_SHARE * len(edges)))]
    blocked = np.zeros(n_verts, np.bool_)
    order_faces = np.argsort(faces.ravel(), kind="stable")
    firsts = np.searchsorted(faces.ravel()[order_faces], np.arange(n_verts + 1))
    chosen = []
    for a, b in edges[order].tolist():
        near = adjacent.indices[adjacent.indptr[a] : adjacent.indptr[a + 1]]
        around = np.concatenate(
            [near, adjacent.indices[adjacent.indptr[b] : adjacent.indptr[b + 1]]]
        )
        n_around = len(np.unique(around))
        # of a tetrahedron two triangles on top of each other would be left
        if blocked[around].any() or n_around != len(around) - 2 or n_around < 5:
            continue
        corners = np.concatenate([order_faces[firsts[v] : firsts[v + 1]] // 3 for v in (a, b)])
        if not _keeps_its_side(positions, faces[corners], a, b):
            continue
        blocked[around] = True
        chosen.append((a, b))
        if len(chosen) == most:
            break
    return np.array(chosen, np.int64).reshape(-1, 2)


def _keeps_its_side(positions: np.ndarray, triangles: np.ndarray, a: int, b: int) -> bool:
    """Tell whether no triangle at a or b turns by more than 60 degrees when both are in the middle."""
    stays = ~((triangles == a).any(axis=1) & (triangles == b).any(axis=1))
    corners = positions[triangles[stays]]
    moved = corners.copy()
    moved[np.isin(triangles[stays], (a, b))] = 0.5 * (positions[a] + positions[b])
    before, after = (np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]) for p in (corners, moved))
    sizes = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return bool(np.all(np.einsum("ij,ij->i", before, after) > 0.5 * sizes))
