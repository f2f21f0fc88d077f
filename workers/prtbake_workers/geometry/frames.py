"""Tangent frames about the vertex normals."""

import numpy as np

from prtbake_workers.arrays import F64, Float64


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
    The construction of Duff et al. 2017 (eq. 4) without a branch: it loses no accuracy anywhere,
    and jumps only where the normal crosses the plane z = 0 towards -z.
    """
    x, y, z = normals.T
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    tangents = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=1)
    bitangents = np.stack([b, sign + y * y * a, -y], axis=1)
    if seed is not None:
        angles = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(normals))[:, None]
        tangents, bitangents = (
            np.cos(angles) * tangents + np.sin(angles) * bitangents,
            np.cos(angles) * bitangents - np.sin(angles) * tangents,
        )
    return np.stack([tangents, bitangents, normals], axis=1)
