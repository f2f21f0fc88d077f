"""A square of triangles whose counts anyone can check on paper."""

import numpy as np
from scipy.spatial import ConvexHull


def grid_faces(side: int) -> np.ndarray:
    """Return the 2 (side - 1)^2 triangles of ``side`` x ``side`` vertices, row by row."""
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    lower = np.stack([corner, corner + 1, corner + side], axis=1)
    upper = np.stack([corner + 1, corner + side + 1, corner + side], axis=1)
    return np.concatenate([lower, upper]).astype(np.int32)


def grid_positions(side: int) -> np.ndarray:
    """Return the (side^2, 3) places of the vertices, one apart in x and y."""
    y, x = np.divmod(np.arange(side * side), side)
    return np.stack([x, y, np.zeros_like(x)], axis=1).astype(np.float64)


def sphere_faces(directions: np.ndarray) -> np.ndarray:
    """Return the triangles of the convex hull of unit ``directions``."""
    return ConvexHull(directions).simplices.astype(np.int32)
