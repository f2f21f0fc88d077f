"""The normals that a file gives: which of them can be used, and what stands in for the others."""

from typing import NamedTuple

import numpy as np

from prtbake_workers.arrays import B8, F64, I64, Bool, Float64, Int64
from prtbake_workers.geometry.mesh import face_area_vectors, vertex_normals


class SettledNormals(NamedTuple):
    """What `settle_normals` decided.

    ``normals`` has 0 0 0 where none of the file can be used: where the file has none (``missing``)
    or one that was ``refused``.  Those that were ``turned`` over are in use.
    """

    normals: Float64[F64, "verts 3"]
    missing: Bool[B8, " verts"]
    refused: Bool[B8, " verts"]
    turned: Bool[B8, " verts"]


def unit_normals(rows: Float64[F64, "verts 3"]) -> Float64[F64, "verts 3"]:
    """Bring to unit length; 0 0 0 stays, and a row with a NaN (no normal) becomes all NaN."""
    longest = np.abs(rows).max(axis=1, keepdims=True)
    # first to a length about 1: squares of very long and very short ones leave the floats
    scaled = rows / np.where(longest > 0.0, longest, 1.0)
    lengths = np.linalg.norm(scaled, axis=1, keepdims=True)
    # -0.0 and 0.0 are one
    units: F64 = scaled / np.where(lengths > 0.0, lengths, 1.0) + 0.0
    units[np.isnan(units).any(axis=1)] = np.nan
    return units


def settle_normals(
    positions: Float64[F64, "verts 3"],
    faces: Int64[I64, "tris 3"],
    flipped: Bool[B8, " tris"],
    given: Float64[F64, "verts 3"],
) -> SettledNormals:
    """Choose the normals of the file that fit the faces.

    One can be used if it lies within 90 degrees of the normal of every face at its vertex.  One
    that does not, because the repair turned over all faces there, is turned over with them; a
    normal that fits the faces as they are now stays, though they were turned.

    Parameters
    ----------
    positions, faces
        The mesh, its winding repaired; every vertex is used.
    flipped
        Faces that the repair turned over.
    given
        As `unit_normals` gives them.
    """
    area_vectors = face_area_vectors(positions, faces)
    usable = np.einsum("ij,ij->i", given, given) > 0.5
    units = np.where(usable[:, None], given, 0.0)
    cosine = np.einsum("tci,ti->tc", units[faces], area_vectors).ravel()
    corner = faces.ravel()
    n = len(positions)
    n_corners = np.bincount(corner, minlength=n)
    fits = np.bincount(corner, cosine > 0.0, n) == n_corners
    opposes = np.bincount(corner, cosine < 0.0, n) == n_corners
    turned = opposes & (np.bincount(corner, np.repeat(flipped, 3), n) == n_corners)
    normals = np.where(turned[:, None], -units, units) + 0.0
    normals[~(fits | turned)] = 0.0
    missing: B8 = np.any(np.isnan(given), axis=1)
    return SettledNormals(normals, missing, ~(missing | fits | turned), turned)


def complete_normals(
    positions: Float64[F64, "verts 3"],
    faces: Int64[I64, "tris 3"],
    place: Int64[I64, " verts"],
    settled: Float64[F64, "verts 3"],
) -> Float64[F64, "verts 3"]:
    """Compute the normals that are 0 0 0.

    Vertices of one position that lack one share it, and only their own faces count: where the
    file splits a position, the faces on the other side of the split have their own normal.
    """
    lacking: B8 = np.all(settled == 0.0, axis=1)
    owner = np.where(lacking, place, len(positions) + np.arange(len(positions)))
    groups = np.unique(owner, return_inverse=True)[1].astype(np.int64)
    return np.where(lacking[:, None], vertex_normals(positions, faces, groups), settled)
