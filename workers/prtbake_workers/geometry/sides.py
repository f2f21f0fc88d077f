"""A surface with two sides: the mesh, and the mesh turned over in its place."""

import numpy as np

from prtbake_workers.arrays import F64, I64, Float64, Int64
from prtbake_workers.geometry.grouping import group_rows
from prtbake_workers.geometry.mesh import Mesh, corner_angles, face_area_vectors
from prtbake_workers.geometry.topology import find_edges


def both_sides(mesh: Mesh) -> Mesh:
    """Give every vertex and every triangle a copy for the other side.

    Parameters
    ----------
    mesh
        One surface, however its triangles are wound.

    Returns
    -------
    Mesh
        As `prtbake_storage.decode.sides` describes: vertex v + n is vertex v with its normal turned
        over, triangle t + m is triangle t with its corners in reverse order.  A corner of a
        triangle is that copy of its vertex whose normal lies on the side that the triangle faces:
        where the mesh is wound as its normals tell, the first copy is the mesh itself.

    Notes
    -----
    Where two triangles that share an edge are wound against each other, as on a Moebius strip they
    must be somewhere, a mean of their normals would be none of either: normals there are means of
    lines.
    """
    n = mesh.n_vertices
    normals = _mended_normals(mesh)
    across = face_area_vectors(mesh.positions, mesh.faces)
    turned = np.einsum("tj,tcj->tc", across, normals[mesh.faces]) < 0.0
    first = mesh.faces + np.where(turned, n, 0)
    second = mesh.faces[:, ::-1] + np.where(turned[:, ::-1], 0, n)

    return Mesh(
        positions=np.tile(mesh.positions, (2, 1)),
        faces=np.concatenate([first, second]).astype(np.int32),
        normals=np.concatenate([normals, -normals]),
        uv=None if mesh.uv is None else np.tile(mesh.uv, (2, 1)),
        colours=None if mesh.colours is None else np.tile(mesh.colours, (2, 1)),
        face_groups=None if mesh.face_groups is None else np.tile(mesh.face_groups, 2),
        group_names=mesh.group_names,
    )


def _mended_normals(mesh: Mesh) -> Float64[F64, "verts 3"]:
    """Give normals, those at edges where the winding clashes computed anew as means of lines.

    Each line counts in the sense of the corner of the largest angle at its vertex.
    """
    # split by normals they are creases, where nothing is mixed
    place, first = group_rows(np.column_stack([mesh.positions, mesh.normals]))
    at = place[mesh.faces]
    edges = find_edges(at)
    clashing = edges.pairs[edges.clashing].ravel()
    if len(clashing) == 0:
        return mesh.normals
    bad = np.zeros(len(first), np.bool_)
    for ends in (at, np.roll(at, -1, axis=1)):
        bad[ends.ravel()[clashing]] = True
    corners: Int64[I64, " corners"] = np.flatnonzero(bad[at.ravel()])
    where = at.ravel()[corners]
    across = face_area_vectors(mesh.positions, mesh.faces)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    lines, angles = across[corners // 3], corner_angles(mesh.positions, mesh.faces).ravel()[corners]
    # the last of a place in rising order of angle is the widest
    order = np.argsort(angles, kind="stable")
    widest = np.zeros((len(bad), 3))
    widest[where[order]] = lines[order]
    sense = np.where((lines * widest[where]).sum(axis=1) < 0.0, -1.0, 1.0)
    weighted = (angles * sense)[:, None] * lines
    sums = np.stack([np.bincount(where, weighted[:, i], len(bad)) for i in range(3)], axis=1)
    own = bad[place]
    normals = mesh.normals.copy()
    normals[own] = sums[place[own]]
    normals[own] /= np.linalg.norm(normals[own], axis=1, keepdims=True)
    return normals
