"""Tangent frames about the vertex normals."""

import numpy as np

from prtbake_workers.arrays import F64, Float64

POLE_SINE = 1e-8
"""Sine of the angle between normal and y below which up tells no direction: +x serves there."""


def tangent_frames(
    normals: Float64[F64, "verts 3"], *, seed: int | None = None
) -> Float64[F64, "verts 3 3"]:
    """Complete each normal to a right-handed orthonormal frame.

    Parameters
    ----------
    normals
        Unit vectors.
    seed
        Turns every frame by a random angle about its normal: no picture may change by it, which
        is what it is there to test.  None for the frames that are stored.

    Returns
    -------
    array
        Rows tangent, bitangent, normal, so that ``local = frame @ world`` and local z is the
        normal.

    Notes
    -----
    The tangent is y x n, horizontal; the bitangent points up the surface.  What blocks the light
    of an object is mostly below it, so in these frames neighbours and strangers alike lose the
    same local directions, and the terms of the whole object share a smaller view basis: on the
    bunny on a plane eight of sixteen terms leave 0.52 % of the energy, against 0.68 % in frames
    carried along the shortest arc from an axis.
    """
    tangents = np.cross([0.0, 1.0, 0.0], normals)
    sine = np.linalg.norm(tangents, axis=1, keepdims=True)
    tangents = np.where(sine > POLE_SINE, tangents, [1.0, 0.0, 0.0])
    # near a pole x is not quite perpendicular to the normal: take its share out
    tangents -= (tangents * normals).sum(axis=1, keepdims=True) * normals
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    bitangents = np.cross(normals, tangents)
    if seed is not None:
        angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(normals))[:, None]
        tangents, bitangents = (
            np.cos(angles) * tangents + np.sin(angles) * bitangents,
            np.cos(angles) * bitangents - np.sin(angles) * tangents,
        )
    return np.stack([tangents, bitangents, normals], axis=1)
