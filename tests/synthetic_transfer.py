"""A made-up transfer tensor with the structure of a real one, for tests and benchmarks.

Vertices lie on a bumpy sphere.  The light axis is a set of equal-area directions, so it is
orthonormal; a vertex sees its upper hemisphere, less what lies behind a horizon that rises over a
part of the surface and ends in a sharp shadow edge.  The view axis holds lobes of falling strength
and rising azimuthal order in the vertex's own frame, as the separable terms of a BRDF have them.
"""

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def equal_area_directions(n: int) -> F64:
    """Return ``n`` nearly equal-area unit directions, a spiral from pole to pole."""
    index = np.arange(n) + 0.5
    y = 1.0 - 2.0 * index / n
    phi = np.pi * (1.0 + 5.0**0.5) * index
    r = np.sqrt(1.0 - y * y)
    return np.column_stack([r * np.cos(phi), y, r * np.sin(phi)])


def synthetic_transfer(
    n_verts: int,
    n_terms: int,
    n_coeffs: int,
    *,
    seed: int = 0,
    roughness: float = 1.0,
    chunk: int = 2048,
) -> F32:
    """Return float32 (verts, terms, coeffs); ``roughness`` makes the bumps so many times finer."""
    rng = np.random.default_rng(seed)
    positions = equal_area_directions(n_verts)
    bumps = rng.standard_normal((4, 3)) * np.array([[2.0], [3.0], [4.0], [6.0]])
    slopes = sum(
        0.12 * np.cos(roughness * (positions @ bump))[:, None] * bump / 4.0 for bump in bumps
    )
    normals = positions + slopes
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangents = np.cross(helper, normals)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    bitangents = np.cross(normals, tangents)
    blocker = np.array([0.6, 0.64, -0.48])
    cap_cosine = 0.35 + 0.5 * (1.0 - (positions @ blocker + 1.0) / 2.0)
    cap_axis = blocker + 0.3 * positions
    cap_axis /= np.linalg.norm(cap_axis, axis=1, keepdims=True)

    lights = equal_area_directions(n_coeffs)
    scale = np.sqrt(4.0 * np.pi / n_coeffs)
    transfer = np.empty((n_verts, n_terms, n_coeffs), dtype=np.float32)
    for start in range(0, n_verts, chunk):
        part = slice(start, start + chunk)
        cosine = np.maximum(normals[part] @ lights.T, 0.0)
        x, y = tangents[part] @ lights.T, bitangents[part] @ lights.T
        azimuth = np.arctan2(y, x)
        # The edge is about one direction wide: what supersampled visibility gives.
        edge = (cap_axis[part] @ lights.T - cap_cosine[part, None]) * np.sqrt(n_coeffs)
        seen = scale * cosine * np.clip(0.5 - edge, 0.0, 1.0)
        for term in range(n_terms):
            order, parity = (term + 1) // 2, term % 2
            turn = np.sin(order * azimuth) if parity else np.cos(order * azimuth)
            lobe = np.exp(-0.5 * term) * cosine ** (1.0 + 0.3 * term) * turn
            transfer[part, term] = seen * lobe
    return transfer
